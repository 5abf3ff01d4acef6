"""Read numbers from text files: poses, calibrations and boxes of layouts such as SRN's and NSVF's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.utilities.files.reading import DataError, malformed, read_text

__all__ = ["LARGEST_TEXT", "read_numbers", "read_rows"]

LARGEST_TEXT = 2**20
"""Largest size in bytes of a file of numbers; a larger file is not read."""

_REMEDY = "download it again"


def read_rows(path: Path, expected: str, root: Path) -> list[list[float]]:
    """The numbers of each line that is not empty.

    Args:
        path: the file.
        expected: what it should hold, for the message.
        root: as in `reading.check_regular`.

    Returns:
        The numbers, which may be infinite or NaN.

    Raises:
        DataError: no such file, not a regular file, too large, or content that is not numbers.
    """
    if not path.exists():
        raise DataError(path, expected, "nothing", _REMEDY)
    with malformed(path, expected):
        lines = read_text(path, LARGEST_TEXT, root).splitlines()
        return [[float(word) for word in line.split()] for line in lines if line.strip()]


def read_numbers(path: Path, counts: Sequence[int], root: Path) -> npt.NDArray[np.float64]:
    """All numbers of a file, which must be finite and as many as one of `counts`; otherwise as `read_rows`."""
    expected = f"{' or '.join(map(str, counts))} finite numbers"
    values = np.array([value for row in read_rows(path, expected, root) for value in row], dtype=np.float64)
    if len(values) not in counts or not np.isfinite(values).all():
        found = f"{len(values)}" if np.isfinite(values).all() else "NaN or infinity"
        raise DataError(path, expected, found, _REMEDY)
    return values
