"""The verbs of the command line, one a module: a dataclass `Arguments` and a function `run`."""

from __future__ import annotations

__all__ = ["EXAMPLES", "VERBS"]

VERBS: dict[str, str] = {
    "demo": "everything once, small: data, training, new views and a report, in minutes",
    "generate": "render meshes, your own or procedural ones, into a data set of posed images",
    "train": "train a model on a data set",
    "evaluate": "compare methods on objects they have never seen, as one table",
    "render": "new views of one object from a few posed images",
    "export": "one object as images, a turntable and a coloured mesh",
    "bake": "one object as a small file of voxels that renders at once, without any network",
    "adapt": "write the weights of one object, to be rendered later without the hypernetwork",
    "inspect": "say what is in a data set or a checkpoint",
    "presets": "list the named configurations",
    "doctor": "say what works on this machine, and how to mend what does not",
}
"""Every verb with one line about it, in the order of the overview."""

EXAMPLES = """\
  hyperplanes demo
  hyperplanes generate --class car --count 70 --resolution 64 --seed 0 --out data/cars
  hyperplanes train --data data/cars --preset quick --out runs/cars
  hyperplanes render --checkpoint runs/cars --views photos/ --out new-views/"""
