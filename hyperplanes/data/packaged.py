"""The scenes that come with the package. This module imports no torch, so that the command line can use it."""

from __future__ import annotations

from pathlib import Path

from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["EXAMPLES", "locate_scene", "remedy_for"]

EXAMPLES = Path(__file__).parent.parent / "examples"
"""The folder that has a folder for each packaged scene."""


def locate_scene(path: str | Path) -> Path:
    """The path; for a bare name at which nothing exists, the path of the packaged scene of that name, if there is one.

    Args:
        path: of posed images, or the name of a packaged scene such as "example-car".
    """
    path = Path(path)
    packaged = EXAMPLES / path.name
    return packaged if len(path.parts) == 1 and not path.exists() and packaged.is_dir() else path


def remedy_for(path: str | Path, otherwise: str = "check the path") -> str:
    """The end of a message about a path at which nothing exists.

    >>> remedy_for("example-cars"), remedy_for("scenes/example-cars")
    ('did you mean example-car?', 'check the path')

    Args:
        path: as in `locate_scene`.
        otherwise: the end if no packaged scene has a similar name.
    """
    path = Path(path)
    scenes = [scene.name for scene in EXAMPLES.iterdir() if scene.is_dir()] if len(path.parts) == 1 else []
    return did_you_mean(path.name, scenes).removeprefix("; ") or otherwise
