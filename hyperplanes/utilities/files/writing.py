"""Atomic writing of files and folders, and a lock: one process at a time writes into a folder."""

from __future__ import annotations

import errno
import itertools
import math
import os
import re
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from hyperplanes.utilities.files.encoding import encode_json
from hyperplanes.utilities.files.reading import DataError

__all__ = ["WriteError", "finite", "one_writer", "write_folder", "write_json", "write_whole"]

_unfinished = itertools.count()

UNFINISHED = re.compile(r"\..+\.(\d+)-\d+\.part")
"""Names of unfinished files, with the process ID."""


class WriteError(DataError, OSError):
    """A file that cannot be written: no space, no permission, a file in place of its folder, or another failure.

    Args:
        path: the file.
        size: of its content in bytes.
        error: of the operating system.
    """

    def __init__(self, path: Path, size: int, error: OSError) -> None:
        found, remedy = error.strerror or str(error), "check the folder and its permissions"
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            found, remedy = f"a full disk ({found})", "free some and run the same command again"
        expected = f"room to write {size} bytes"
        above = next((each for each in path.parents if os.path.exists(each)), path)
        if error.errno in {errno.EEXIST, errno.ENOTDIR} and above.is_file():
            path, expected, found, remedy = above, "a folder to write into", "a file", "name another one"
        super().__init__(path, expected, found, remedy)


def write_whole(path: str | Path, data: bytes, scratch: str | Path | None = None, *, durable: bool = True) -> None:
    """Write a file atomically: under a temporary name beside it, then renamed.

    Args:
        path: the file; its folder is created if absent.
        data: its content.
        scratch: a folder of the same file system for the unfinished file instead.
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
        except FileNotFoundError:  # checking for the folder each time would cost as much as the file
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
    """Flush a rename to the disk; file systems that cannot open folders do so by themselves."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def one_writer(folder: str | Path) -> Generator[None]:
    """A lock on a folder, created if absent, for one writing process at a time.

    The operating system releases it when the process ends, however it ends. Meanwhile the folder holds a file `.lock`.

    Args:
        folder: the folder to write into.

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
            lock.close()  # a writer has just finished and removed its file
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
    """Delete unfinished files of killed processes in a folder and in its subfolders that are not locked."""
    for place in (folder, *(child for child in folder.iterdir() if child.is_dir() and not child.is_symlink())):
        with suppress(PermissionError):  # a folder of another user, such as lost+found
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
    """Write a JSON file atomically; infinities and NaN, which JSON lacks, become null."""
    write_whole(path, encode_json(finite(value)))


def finite(value: object) -> object:
    """A value for JSON, which has no infinities and no NaN: they become None."""
    if isinstance(value, Mapping):
        return {name: finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_folder(folder: str | Path, files: dict[str, bytes], scratch: str | Path) -> None:
    """Write a folder of files atomically.

    The folder is renamed once: renaming each file would take twice as long as writing it.

    Args:
        folder: the folder; if it already exists, its files are replaced one by one.
        files: content by name inside the folder.
        scratch: a folder of the same file system for the unfinished folder.

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
