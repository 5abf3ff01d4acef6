"""Read arrays from .npz and .npy files: of bounded size, and never a pickle."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.utilities.files.reading import MALFORMED, DataError, check_regular, malformed, read_bytes

__all__ = ["read_array", "read_arrays"]

LARGEST_ARRAY = 2 * 2**30
"""Largest size in bytes of the arrays that are read from one .npz file."""


def read_arrays(path: str | Path, names: set[str], root: Path | None = None) -> dict[str, npt.NDArray[Any]]:
    """Some arrays of an .npz file. Their sizes are checked before they are decompressed.

    Args:
        path: the file.
        names: the arrays to read; those that the file lacks are left out.
        root: as in `reading.check_regular`.

    Returns:
        The arrays by name.

    Raises:
        DataError: no such file, not an .npz file, a pickle in it, or arrays of more than LARGEST_ARRAY bytes.
    """
    path = Path(path)
    try:
        check_regular(path, root=root)
        with zipfile.ZipFile(path) as archive:
            wanted = [entry for entry in archive.infolist() if entry.filename[:-4] in names]
            total = sum(max(entry.file_size, _claimed_size(archive, entry)) for entry in wanted)
        if total > LARGEST_ARRAY:
            raise DataError(path, f"at most {LARGEST_ARRAY} bytes of arrays", f"{total}", "split it")
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files if name in names}
    except FileNotFoundError as error:
        raise DataError(path, "an .npz file", "nothing", "check the path") from error
    except DataError:
        raise
    except MALFORMED + (OSError,) as error:
        raise DataError(path, "an .npz file of plain arrays", str(error), "write or download it again") from error


def read_array(path: Path, expected: str, largest: int, root: Path) -> npt.NDArray[Any]:
    """The array in an .npy file of at most `largest` bytes; raises DataError for a malformed file or a pickle."""
    with malformed(path, expected):
        return np.load(io.BytesIO(read_bytes(path, largest, root)), allow_pickle=False)


def _claimed_size(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """The size in bytes that an array's own header states; the size that the archive states may be another."""
    with archive.open(entry) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(member)
    if min(shape, default=0) < 0:
        raise ValueError(f"an array of shape {shape}")
    return math.prod(shape) * dtype.itemsize
