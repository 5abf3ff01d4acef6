"""Files of cameras that programs give any name: found by how they begin."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hyperplanes.utilities.files import DataError

__all__ = ["find_by_head", "only_one"]

_HEAD = 4096  # bytes


def find_by_head(folder: Path, ending: str, accepted: Callable[[str], bool]) -> list[Path]:
    """The files of a folder with an ending whose first bytes are accepted, sorted by name.

    Args:
        folder: to look into, not into the folders in it.
        ending: of the names, such as ".csv".
        accepted: whether a file that begins so is one of them; what is no UTF-8 is replaced.
    """
    return [path for path in sorted(folder.glob(f"*{ending}")) if path.is_file() and accepted(_head(path))]


def _head(path: Path) -> str:
    try:
        with open(path, "rb") as file:
            return file.read(_HEAD).decode("utf-8-sig", errors="replace")
    except OSError:
        return ""


def only_one(found: list[Path], folder: Path, what: str) -> Path:
    """The only file that was found.

    Args:
        found: by `find_by_head`.
        folder: where.
        what: they are, for the message.

    Returns:
        Its path.

    Raises:
        DataError: none, or several.
    """
    if len(found) == 1:
        return found[0]
    names = " and ".join(path.name for path in found[:2]) or "none"
    remedy = "move the others out of the folder" if found else "export the cameras again"
    raise DataError(folder, f"one {what}", names, remedy)
