"""What is wrong with a file that somebody else wrote."""

from __future__ import annotations

from pathlib import Path

__all__ = ["DataError"]


class DataError(ValueError):
    """A file is not what it should be: one line that names it, what was expected, what was found, what to do.

    Args:
        where: the file or folder; alone, the whole message.
        expected: what should have been there.
        found: what is there.
        remedy: what the user can do.

    >>> print(DataError("a/transforms.json", "a JSON object", "a list", "export it again"))
    a/transforms.json: expected a JSON object, found a list; export it again
    """

    def __init__(self, where: str | Path, expected: str = "", found: str = "", remedy: str = "") -> None:
        text = f"{where}: expected {expected}, found {found}; {remedy}" if expected else str(where)
        super().__init__(" ".join(text.split()))
