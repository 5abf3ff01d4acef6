"""The verbs of the command line, one a module: a dataclass `Arguments` and a function `run`.

Another package adds a verb by an entry point of the group `hyperplanes.commands` that names a `Verb`, in a module that
imports nothing heavy; so does data_gen with `generate` and `inspect`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.utilities.errors import nearest

__all__ = ["EXAMPLES", "VERBS", "Verb", "find_verb", "find_verbs", "split_settings"]


@dataclass(frozen=True)
class Verb:
    """A verb of the command line.

    Attributes:
        module: Name of the module with its `Arguments` and its `run`, imported when the verb is used.
        about: One line about it.
    """

    module: str
    about: str

    def load(self) -> Any:
        """The module with its `Arguments` and its `run`."""
        return import_module(self.module)


VERBS: dict[str, str] = {
    "reproduce": "a table or figure of the paper, beside the paper's numbers",
    "demo": "everything once, small: data, training, new views and a report, in minutes",
    "train": "train a model on a data set",
    "evaluate": "compare methods on objects they have never seen, as one table",
    "capture": "photographs or a video to a scene: camera poses, masks, which way is up",
    "render": "new views of one object from a few posed images",
    "view": "one object in the browser, while a model adapts to it",
    "export": "one object as images, a turntable, a mesh, splats, and a page that turns it",
    "bake": "one object as a small file of voxels that renders at once, without any network",
    "adapt": "write the weights of one object, to be rendered later without the hypernetwork",
    "presets": "list the named configurations",
    "doctor": "say what works on this machine, and how to fix what does not",
}
"""The verbs of this package with one line about each, in the order of the overview."""

EXAMPLES = """\
  hyperplanes demo
  hyperplanes generate --class car --count 70 --resolution 64 --seed 0 --out data/cars
  hyperplanes train --data data/cars --preset quick --out runs/cars
  hyperplanes capture photos/ --out scene
  hyperplanes render --checkpoint runs/cars --views scene --out new-views/"""


def find_verbs() -> dict[str, Verb]:
    """All verbs by name: those of this package, then those of the other packages that are installed."""
    own = {name: Verb(f"{__name__}.{name}", about) for name, about in VERBS.items()}
    return own | load_entries(__name__, own)


def find_verb(name: str) -> Verb:
    """One verb.

    Args:
        name: As it stands on the command line.

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
    """The options of a verb, and those with a dot in their names, which set a field of a model or a training.

    >>> split_settings(["--model.network.depth", "4", "--out", "runs/a.b"])
    (['--out', 'runs/a.b'], ['--model.network.depth', '4'])

    Args:
        arguments: What stands after the verb.

    Returns:
        Both, each option with its values.
    """
    plain: list[str] = []
    dotted: list[str] = []
    here = plain
    for argument in arguments:
        if argument.startswith("--"):
            here = dotted if "." in argument.partition("=")[0] else plain
        here.append(argument)
    return plain, dotted
