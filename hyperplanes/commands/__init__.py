"""The verbs of the command line. Each is a module with a dataclass `Arguments` and a function `run`.

If the same command continues an interrupted one, the module has RESUMES = True.

Another package adds a verb by an entry point of the group `hyperplanes.commands` that names a `Verb`, as data_gen does
with `generate` and `inspect`. The module of that `Verb` must import nothing heavy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.utilities.messages.errors import nearest

__all__ = ["EXAMPLES", "VERBS", "Verb", "find_verb", "find_verbs", "split_settings"]


@dataclass(frozen=True)
class Verb:
    """A verb of the command line.

    Attributes:
        module: Name of the module that has its `Arguments` and its `run`. It is imported when the verb is used.
        about: A description in one line.
    """

    module: str
    about: str

    def load(self) -> Any:
        """The module with its `Arguments` and its `run`."""
        return import_module(self.module)


VERBS: dict[str, str] = {
    "reproduce": "reproduce a table or a figure of the paper, beside the paper's numbers",
    "demo": "make data, train, render new views and write a page about them, in minutes",
    "train": "train a model on a data set",
    "evaluate": "compare methods on held-out objects, in one table",
    "capture": "make a scene with camera poses and masks from photographs or a video",
    "render": "render new views of one object from a few posed images",
    "view": "show one object in the browser while a model adapts to it",
    "export": "write one object as images, a turntable, a mesh, points, splats or an HTML page",
    "bake": "write one object as a small file of voxels, which are rendered without a network",
    "adapt": "write the weights of one object, for rendering without the hypernetwork",
    "presets": "list the named configurations",
    "doctor": "report what works on this machine, and how to fix what does not",
}
"""The verbs of this package and a description of each, in the order of the overview."""

EXAMPLES = """\
  hyperplanes demo
  hyperplanes generate --class car --count 70 --resolution 64 --seed 0 --out data/cars
  hyperplanes train --data data/cars --preset quick --out runs/cars
  hyperplanes capture photos/ --out scene
  hyperplanes render --checkpoint small --views scene --out new-views/"""


def find_verbs() -> dict[str, Verb]:
    """All verbs by name: those of this package, then those of the other packages that are installed."""
    own = {name: Verb(f"{__name__}.{name}", about) for name, about in VERBS.items()}
    return own | load_entries(__name__, own)


def find_verb(name: str) -> Verb:
    """One verb.

    Args:
        name: Its name on the command line.

    Returns:
        The verb.

    Raises:
        ValueError: No installed package has such a verb.
    """
    if name in VERBS:
        return Verb(f"{__name__}.{name}", VERBS[name])
    verbs = find_verbs()
    if name not in verbs:
        raise ValueError(f"no verb {name!r}; {nearest(name, list(verbs))}")
    return verbs[name]


def split_settings(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate the options of a verb from those with a dot in their names, which set a field of a model or a training.

    >>> split_settings(["--model.network.depth", "4", "--out", "runs/a.b"])
    (['--out', 'runs/a.b'], ['--model.network.depth', '4'])

    Args:
        arguments: The command line after the verb.

    Returns:
        The options without and those with a dot, each followed by its values.
    """
    plain: list[str] = []
    dotted: list[str] = []
    here = plain
    for argument in arguments:
        if argument.startswith("--"):
            here = dotted if "." in argument.partition("=")[0] else plain
        here.append(argument)
    return plain, dotted
