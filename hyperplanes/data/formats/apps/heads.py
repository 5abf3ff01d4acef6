"""Find files of cameras by their first bytes, since their names are chosen freely."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hyperplanes.utilities.files.reading import DataError

__all__ = ["find_by_head", "only_one"]

_HEAD = 4096  # bytes


def find_by_head(folder: Path, ending: str, accepted: Callable[[str], bool]) -> list[Path]:
    """The files of a folder that have a suffix and whose first 4096 bytes are accepted, sorted by name.

    Args:
        folder: to search, without its subfolders.
        ending: the suffix, such as ".csv".
        accepted: whether a file that begins with this text is one of them. Bytes that are not UTF-8 are replaced.
    """
    return [path for path in sorted(folder.glob(f"*{ending}")) if path.is_file() and accepted(_head(path))]


def _head(path: Path) -> str:
    """The first bytes of a file as text; empty if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(_HEAD).decode("utf-8-sig", errors="replace")
    except OSError:
        return ""


def only_one(found: list[Path], folder: Path, what: str) -> Path:
    """The only file that was found.

    Args:
        found: the result of `find_by_head`.
        folder: that was searched, for the message.
        what: the kind of file, for the message.

    Returns:
        Its path.

    Raises:
        DataError: no file or several files were found.
    """
    if len(found) == 1:
        return found[0]
    names = " and ".join(path.name for path in found[:2]) or "none"
    remedy = "move the others out of the folder" if found else "export the cameras again"
    raise DataError(folder, f"one {what}", names, remedy)
