"""Reading whole files: regular files only, checked JSON, safe paths, and errors for malformed content."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = [
    "DATA_SET",
    "MANIFEST",
    "PROGRESS_FOLDER",
    "DataError",
    "check_link",
    "check_regular",
    "folder_checksum",
    "format_of",
    "inside",
    "list_files",
    "malformed",
    "read_bytes",
    "read_json",
    "read_text",
]

MANIFEST, DATA_SET = "manifest.json", "hyperplanes-dataset"
"""The file that describes a data set, and the value of "format" in it."""

PROGRESS_FOLDER = ".progress"
"""The folder in a data set that `generate` removes when all objects are written."""

LARGEST_JSON = 256 * 2**20
"""Largest JSON file that is read, in bytes."""

LARGEST_FILE = 2 * 2**30
"""Largest other file that is read whole, in bytes."""

MALFORMED = (
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, RuntimeError,
    SyntaxError, TypeError, ValueError, struct.error, zipfile.BadZipFile, tokenize.TokenError, zlib.error,
)  # fmt: skip
"""What parsers raise on unexpected content."""


class DataError(ValueError):
    """A file with wrong content: one line with its name, what was expected, what was found, and what to do.

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


@contextmanager
def malformed(path: str | Path, expected: str) -> Generator[None]:
    """Turn what parsers raise on unexpected content into a DataError that names the file.

    For the few places where bytes become values: a malformed file is a wrong input, not a bug. DataErrors and errors of
    the operating system pass unchanged.

    Raises:
        DataError: any of MALFORMED.
    """
    try:
        yield
    except DataError:
        raise
    except MALFORMED as error:
        found = f"{type(error).__name__} ({error})" if str(error) else type(error).__name__
        raise DataError(path, expected, f"something else: {found[:200]}", "write or download it again") from error


def check_regular(path: str | Path, largest: int = LARGEST_FILE, root: str | Path | None = None) -> int:
    """The size in bytes of a regular file, links followed; FileNotFoundError where there is none.

    Opening a pipe would wait for a writer for ever, and reading a device might never end.

    Args:
        path: the file.
        largest: most bytes.
        root: a folder that must contain it, symbolic links followed; any when None.

    Raises:
        DataError: a folder, pipe, socket or device, too large a file, or a link that leads out of the root.
    """
    if root is not None:
        check_link(path, root)
    found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
        kind = kinds.get(stat.S_IFMT(found.st_mode), "a device")
        raise DataError(path, "a regular file", kind, "copy its content into a file")
    if found.st_size > largest:
        raise DataError(path, f"at most {largest} bytes", f"{found.st_size}", "is it the right file?")
    return found.st_size


def check_link(path: str | Path, root: str | Path) -> None:
    """Check that a path lies inside a folder, symbolic links followed.

    Args:
        path: of a file or a folder, which need not exist.
        root: the folder.

    Raises:
        DataError: a link that leads out of it.
    """
    target = Path(path).resolve()
    if not target.is_relative_to(Path(root).resolve()):
        remedy = "copy what it leads to into the folder, or give a folder that holds both"
        raise DataError(path, f"a file inside {root}", f"a symbolic link to {target}", remedy)


def list_files(folder: str | Path, suffixes: Collection[str], root: str | Path | None = None) -> list[Path]:
    """The files of a folder with certain endings, sorted by name.

    Args:
        folder: the folder; subfolders are not searched.
        suffixes: the endings, in lower case.
        root: as in `check_regular`, for each of the files; the folder itself when None.

    Returns:
        Their paths. A link that leads out of the root is a DataError.
    """
    found = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in suffixes)
    for path in found:
        if path.is_symlink() or root is not None:
            check_link(path, root or folder)
    return found


def folder_checksum(folder: str | Path, but: str | Path | None = None) -> str:
    """A checksum that notices changes of a folder without reading every file.

    It covers the names and sizes of all files, and their modification times, or instead of these the content of
    `manifest.json` where a data set has one: copied or generated again, it has the same checksum.

    Args:
        folder: its files at any depth count, but for hidden files and folders; links to each folder are followed once.
        but: a folder in it to leave out.

    Returns:
        Ten hexadecimal digits; those of an empty folder if it does not exist.
    """
    root = Path(folder).resolve()
    manifest = root / MANIFEST
    stated = hashlib.sha256(read_bytes(manifest)).hexdigest() if manifest.is_file() else ""
    seen = {str(root)} | ({os.path.realpath(but)} if but is not None else set())
    files: list[tuple[str, int, int]] = []
    for place, folders, names in os.walk(root, followlinks=True):
        inner = {os.path.realpath(os.path.join(place, name)): name for name in sorted(folders) if name[0] != "."}
        folders[:] = [name for target, name in inner.items() if target not in seen]  # what os.walk visits next
        seen |= inner.keys()
        for name in names:
            path = os.path.join(place, name)
            if name[0] != "." and os.path.isfile(path):
                found = os.stat(path)
                files.append((os.path.relpath(path, root), found.st_size, 0 if stated else found.st_mtime_ns))
    return hashlib.sha256(json.dumps([stated, sorted(files)]).encode()).hexdigest()[:10]


def read_bytes(path: str | Path, largest: int = LARGEST_FILE, root: str | Path | None = None) -> bytes:
    """The content of a regular file; arguments and errors as in `check_regular`."""
    check_regular(path, largest, root)
    return Path(path).read_bytes()


def read_text(path: str | Path, largest: int = LARGEST_JSON, root: str | Path | None = None) -> str:
    """The text of a regular UTF-8 file; as `check_regular`, and UnicodeDecodeError if it is not text."""
    return read_bytes(path, largest, root).decode("utf-8")


def read_json(path: str | Path, root: str | Path | None = None) -> dict[str, Any]:
    """The JSON object in a file.

    Args:
        path: the file.
        root: as in `check_regular`.

    Raises:
        DataError: no such file, not a regular one, too large, not JSON, not an object, or an integer beyond the
            64 bits of NumPy and PyTorch.
    """
    path = Path(path)
    try:
        value = json.loads(read_bytes(path, LARGEST_JSON, root), parse_int=_whole_number)
    except DataError:
        raise
    except FileNotFoundError as error:
        raise DataError(path, "a JSON file", "nothing", "check the path") from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        raise DataError(path, "valid JSON", str(error), "write or download the file again") from error
    except OSError as error:
        raise DataError(path, "a readable file", error.strerror or str(error), "check its permissions") from error
    if not isinstance(value, dict):
        raise DataError(path, "a JSON object", f"a {type(value).__name__}", "check that it is the right file")
    return value


def _whole_number(digits: str) -> int:
    if len(digits) > 20 or not -(2**63) <= int(digits) < 2**63:
        raise OverflowError(f"a whole number of {len(digits)} digits")
    return int(digits)


LONGEST_NAME = 255  # bytes of one name on common file systems


def inside(folder: str | Path, relative: str, source: str | Path) -> Path:
    """The path of a file named in another file, checked to lie in a folder.

    Args:
        folder: the folder that must contain it, symbolic links followed.
        relative: the name as it was written.
        source: the file that names it, for the message.

    Returns:
        The path; the file need not exist.

    Raises:
        DataError: an absolute path, one that leaves the folder, or an impossible file name.
    """
    root = Path(folder).resolve()
    text = relative.replace("\\", "/") if isinstance(relative, str) else ""
    if not text or "\0" in text or Path(text).is_absolute() or os.path.normpath(text).split("/")[0] == "..":
        raise DataError(source, f"file names inside {folder}", repr(relative), "move the file into the folder")
    if any(len(os.fsencode(part)) > LONGEST_NAME for part in text.split("/")):
        found = f"{text[:40]}..., {len(text)} characters"
        raise DataError(source, f"file names of at most {LONGEST_NAME} bytes", found, "export the file again")
    if not (target := (root / text).resolve()).is_relative_to(root):
        found = f"{relative!r}, a symbolic link to {target}"
        remedy = "copy the files to where the link is, or give a folder that holds both"
        raise DataError(source, f"file names inside {folder}", found, remedy)
    return Path(folder) / text


def format_of(path: str | Path, formats: Sequence[str]) -> str:
    """The format of a file to be written, by the ending of its name, in lower case.

    Args:
        path: the file.
        formats: the supported endings.

    Raises:
        ValueError: another ending.

    >>> format_of("chair.GLB", ("ply", "glb"))
    'glb'
    """
    kind = Path(path).suffix.lower().lstrip(".")
    if kind not in formats:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(formats)}, got {kind!r}")
    return kind
