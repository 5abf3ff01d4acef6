"""Reading and writing whole files: only regular ones, checked JSON, safe paths, atomic writes, one writer a folder."""

from __future__ import annotations

import errno
import itertools
import json
import math
import os
import re
import shutil
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hyperplanes.utilities.encoding import encode_json

__all__ = [
    "DataError",
    "WriteError",
    "check_link",
    "check_regular",
    "format_of",
    "inside",
    "list_files",
    "malformed",
    "one_writer",
    "read_bytes",
    "read_json",
    "read_text",
    "write_folder",
    "write_json",
    "write_whole",
]

_unfinished = itertools.count()

UNFINISHED = re.compile(r"\..+\.(\d+)-\d+\.part")
"""Names of files that are being written, with the number of the process."""

LARGEST_JSON = 256 * 2**20
"""Bytes above which a JSON file is refused unread."""

LARGEST_FILE = 2 * 2**30
"""Bytes above which any other file that is read whole is refused unread."""

MALFORMED = (
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, RuntimeError,
    SyntaxError, TypeError, ValueError, struct.error, zipfile.BadZipFile, tokenize.TokenError, zlib.error,
)  # fmt: skip
"""What parsers raise where content is not what they took for granted."""


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


class WriteError(DataError, OSError):
    """A file that cannot be written: no space, no permission, or another failure of the operating system.

    Args:
        path: the file.
        size: of its content in bytes.
        error: what the operating system said.
    """

    def __init__(self, path: Path, size: int, error: OSError) -> None:
        found, remedy = error.strerror or str(error), "check the folder and its permissions"
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            found, remedy = f"a full disk ({found})", "free some and run the same command again"
        super().__init__(path, f"room to write {size} bytes", found, remedy)


@contextmanager
def malformed(path: str | Path, expected: str) -> Generator[None]:
    """Turns what parsers raise on content that they did not expect into a DataError that names the file.

    For the few places where bytes become values: a file that nobody foresaw is a wrong input and no fault of the
    program. DataErrors and errors of the operating system pass as they are.

    Args:
        path: of what is read within.
        expected: what it should be.

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
    """The size in bytes of a regular file, or of what a link to one leads to; FileNotFoundError where there is none.

    Opening a pipe waits for a writer for ever, and reading a device may never end.

    Args:
        path: the file.
        largest: bytes above which it is refused.
        root: a folder that it may not lie outside of, symbolic links followed; anywhere when None.

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
        path: of a file or a folder, which need not be there.
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
        folder: to look into, not into the folders in it.
        suffixes: the endings, in small letters.
        root: as in `check_regular`, for each of the files; the folder itself when None.

    Returns:
        Their paths. A link that leads out of the root is a DataError.
    """
    found = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in suffixes)
    for path in found:
        if path.is_symlink() or root is not None:
            check_link(path, root or folder)
    return found


def read_bytes(path: str | Path, largest: int = LARGEST_FILE, root: str | Path | None = None) -> bytes:
    """The content of a regular file; as `check_regular`."""
    check_regular(path, largest, root)
    return Path(path).read_bytes()


def read_text(path: str | Path, largest: int = LARGEST_JSON, root: str | Path | None = None) -> str:
    """The content of a regular file of UTF-8; as `check_regular`, and UnicodeDecodeError where it is no text."""
    return read_bytes(path, largest, root).decode("utf-8")


def read_json(path: str | Path, root: str | Path | None = None) -> dict[str, Any]:
    """The JSON object in a file.

    Args:
        path: the file.
        root: as in `check_regular`.

    Raises:
        DataError: no such file, not a regular one, too large, not JSON, not an object, or a whole number beyond 64
            bits, which neither NumPy nor PyTorch has.
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


LONGEST_NAME = 255  # bytes of a part of a path, on every common file system


def inside(folder: str | Path, relative: str, source: str | Path) -> Path:
    """The path of a file named in another file, which may not leave the folder.

    Args:
        folder: what must hold the file, symbolic links followed.
        relative: the name as it was written.
        source: the file that names it, for the message.

    Returns:
        The path; whether there is such a file is not looked at.

    Raises:
        DataError: an absolute path, one that leaves the folder, or a name that no file can have.
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
    """The format of a file that is to be written, by the ending of its name, in small letters.

    Args:
        path: the file.
        formats: the known ones.

    Raises:
        ValueError: another ending.

    >>> format_of("chair.GLB", ("ply", "glb"))
    'glb'
    """
    kind = Path(path).suffix.lower().lstrip(".")
    if kind not in formats:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(formats)}, got {kind!r}")
    return kind


def write_whole(path: str | Path, data: bytes, scratch: str | Path | None = None, *, durable: bool = True) -> None:
    """Write a file so that nobody ever sees half of it: beside its name first, then renamed.

    Args:
        path: the file; its folder is made when absent.
        data: all of it.
        scratch: where the unfinished file lies instead, a folder of the same file system.
        durable: wait until it is on the disk, so that it is whole even after a power failure.

    Raises:
        WriteError: no space, no permission, or another failure of the operating system.
    """
    path = Path(path)
    temporary = None
    try:
        if scratch is None:
            path.parent.mkdir(parents=True, exist_ok=True)
        name = _unfinished_beside(path, scratch)
        with open(name, "wb") as file:
            temporary = name
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        try:
            os.replace(temporary, path)
        except FileNotFoundError:  # looking for the folder every time would cost as much as the file
            path.parent.mkdir(parents=True, exist_ok=True)
            os.replace(temporary, path)
        if durable:
            _sync_folder(path.parent)
    except OSError as error:
        raise WriteError(path, len(data), error) from error
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def _sync_folder(folder: Path) -> None:
    """Have a rename on the disk too; file systems that cannot open folders do it by themselves."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def one_writer(folder: str | Path) -> Generator[None]:
    """The time in which nobody else may write into a folder, which is made when absent.

    The lock belongs to the process: it ends with it, however it ends. A file `.lock` stands in the folder meanwhile.

    Args:
        folder: to write into.

    Raises:
        DataError: another process at work there, a file in its place, or a folder that cannot be written to.
    """
    import fcntl

    folder = Path(folder)
    path = folder / ".lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            lock = open(path, "w")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if path.exists() and os.path.samestat(os.fstat(lock.fileno()), os.stat(path)):
                    break
            except BaseException:
                lock.close()
                raise
            lock.close()  # of a writer that has just finished and taken its file away
    except BlockingIOError as error:
        remedy = "wait for it, or name another folder"
        raise DataError(folder, "a folder of its own", "another hyperplanes at work there", remedy) from error
    except (FileExistsError, NotADirectoryError) as error:
        raise DataError(folder, "a folder to write into", "a file", "name another one") from error
    except OSError as error:
        found = error.strerror or str(error)
        raise DataError(folder, "a folder to write into", found, "name another one") from error
    try:
        _delete_unfinished(folder)
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        lock.close()


def _delete_unfinished(folder: Path) -> None:
    """Delete what killed processes have left half written in a folder, and in those in it that nobody has locked."""
    for place in (folder, *(child for child in folder.iterdir() if child.is_dir() and not child.is_symlink())):
        if place != folder and (place / ".lock").exists():
            continue
        for path in place.glob(".*.part"):
            owner = UNFINISHED.fullmatch(path.name)
            if owner is not None and not _is_running(int(owner[1])):
                with suppress(OSError):
                    shutil.rmtree(path) if path.is_dir() else path.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def write_json(path: str | Path, value: object) -> None:
    """Write a JSON file, whole or not at all; infinity and what is not a number, which JSON has not, become null."""
    write_whole(path, encode_json(_finite(value)))


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_folder(folder: str | Path, files: dict[str, bytes], scratch: str | Path) -> None:
    """Write a folder of files so that nobody ever sees half of it; a rename a file takes twice as long as writing it.

    Args:
        folder: the folder; where it exists already, its files are replaced one by one.
        files: content by name inside the folder.
        scratch: a folder of the same file system, where it lies until it is whole.

    Raises:
        WriteError: no space, no permission, or another failure of the operating system.
    """
    folder = Path(folder)
    temporary = _unfinished_beside(folder, scratch)
    try:
        for parent in {os.path.dirname(name) for name in files}:
            os.makedirs(os.path.join(temporary, parent), exist_ok=True)
        for name, data in files.items():
            with open(os.path.join(temporary, name), "wb") as file:
                file.write(data)
        folder.parent.mkdir(parents=True, exist_ok=True)
        os.rename(temporary, folder)
    except OSError as error:
        if error.errno not in {errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR}:
            raise WriteError(folder, sum(map(len, files.values())), error) from error
        for name, data in files.items():
            write_whole(folder / name, data, scratch, durable=False)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _unfinished_beside(path: Path, scratch: str | Path | None) -> str:
    return os.path.join(scratch or path.parent, f".{path.name}.{os.getpid()}-{next(_unfinished)}.part")
