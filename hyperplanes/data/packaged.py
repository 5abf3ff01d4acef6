"""The scenes that come with the package. This module imports no torch, so that the command line can use it."""

from __future__ import annotations

from pathlib import Path

__all__ = ["EXAMPLES", "locate_scene"]

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
