"""The manifest of a data set: what was requested, written and skipped, and why; and its verification.

Objects stay folders and files for other projects' loaders, which cannot read archives of WebDataset or Hugging Face
datasets; so one JSON file lists what exists, with checksums.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperplanes.utilities.files.encoding import encode_json, sha256
from hyperplanes.utilities.files.reading import (
    DATA_SET,
    MANIFEST,
    PROGRESS_FOLDER,
    DataError,
    inside,
    malformed,
    read_bytes,
    read_json,
)
from hyperplanes.utilities.files.settings import flattened
from hyperplanes.utilities.files.writing import one_writer, write_whole

if TYPE_CHECKING:
    from data_gen.datasets.sources import Item

__all__ = ["GenerationState", "Verification", "build_manifest", "holds_data_set", "verify"]

VERSION = 1

_DIFFERENCES = 5
"""Most differences between two configurations that a message names."""

Entry = dict[str, Any]
"""{"name", "record", "files": {relative path: sha256}} of a finished object."""


@dataclass(frozen=True)
class Verification:
    """The result of comparing files with their checksums.

    Attributes:
        files: number of files compared.
        missing: relative paths of absent files.
        changed: relative paths of files with other content.
    """

    files: int
    missing: list[str]
    changed: list[str]

    @property
    def intact(self) -> bool:
        """Whether every file exists unchanged."""
        return not self.missing and not self.changed

    def lines(self) -> list[str]:
        """The result as text, one fact per line."""
        if self.intact:
            return [f"checksums: {self.files:,} files as they were written"]
        return [f"checksums: {name} is missing" for name in self.missing] + [
            f"checksums: {name} has changed since it was written" for name in self.changed
        ]


def build_manifest(
    configuration: dict[str, Any],
    items: Sequence[Item],
    entries: Iterable[Entry],
    skipped: Iterable[tuple[str, str]],
    facts: dict[str, Any],
) -> dict[str, Any]:
    """The manifest of a finished data set, independent of time and order of the work.

    Args:
        configuration: everything that affects the bytes.
        items: all requested objects.
        entries: the finished ones.
        skipped: names and reasons of the others.
        facts: for readers: layout, scene_sphere, near, far, renderer.

    Returns:
        A JSON-able dictionary.
    """
    by_name = {entry["name"]: entry for entry in entries}
    done = [item for item in items if item.name in by_name]
    unlisted = [item.name for item in done if item.unlisted]
    incomplete = [item.name for item in done if "lost_files" in by_name[item.name]["record"]]
    warned = [item.name for item in done if "warnings" in by_name[item.name]["record"]]
    splits = {split: [item.name for item in done if item.split == split] for split in ("train", "val", "test")}
    return {
        "format": DATA_SET,
        "version": VERSION,
        **facts,
        "configuration": configuration,
        "splits": splits,
        "not_in_split_file": {"count": len(unlisted), "split": "train", "names": unlisted},
        "with_lost_files": {"count": len(incomplete), "names": incomplete},
        "with_warnings": {"count": len(warned), "names": warned},
        "objects": {item.name: {**by_name[item.name]["record"], "files": by_name[item.name]["files"]} for item in done},
        "skipped": [{"name": name, "reason": reason} for name, reason in sorted(skipped)],
    }


def holds_data_set(folder: Path) -> bool:
    """Whether a folder holds a data set of `generate`, finished or not."""
    if (folder / PROGRESS_FOLDER / "configuration.json").is_file():
        return True
    with suppress(DataError):
        return (folder / MANIFEST).is_file() and read_json(folder / MANIFEST).get("format") == DATA_SET
    return False


def verify(folder: str | Path) -> Verification:
    """Compare every file of a data set with its checksum in the manifest.

    Returns:
        The missing and changed files.

    Raises:
        DataError: if there is no manifest, or one without checksums.
    """
    manifest = Path(folder) / MANIFEST
    with malformed(manifest, "a manifest"):
        objects = read_json(manifest).get("objects")
        if not isinstance(objects, dict):
            raise DataError(manifest, "objects with checksums", "none", "it was not made by hyperplanes generate")
        checksums = [each for record in objects.values() for each in record.get("files", {}).items()]
        found = [(name, _checksum(manifest.parent, name), expected) for name, expected in checksums]
    missing = [name for name, checksum, _ in found if checksum is None]
    changed = [name for name, checksum, expected in found if checksum not in (None, expected)]
    return Verification(len(found), missing, changed)


def _checksum(folder: Path, name: str) -> str | None:
    """The checksum of a file that the manifest of a folder names; None if it is missing."""
    path = inside(folder, name, folder / MANIFEST)
    return sha256(read_bytes(path)) if path.is_file() else None


class GenerationState:
    """The existing part of a data set, for resuming. A context manager that holds the folder's lock.

    Args:
        out: the folder of the data set.
        configuration: everything that affects the bytes of the data set.

    Raises:
        DataError: a folder with other content, made with another configuration, or in use by another process.
    """

    def __init__(self, out: Path, configuration: dict[str, Any]) -> None:
        self.out = out
        self.folder = out / PROGRESS_FOLDER
        self.scratch = self.folder / "unfinished"
        self.configuration = configuration

    def __enter__(self) -> GenerationState:
        """Lock the folder and check it."""
        with ExitStack() as stack:
            stack.enter_context(one_writer(self.out))
            self._check()
            shutil.rmtree(self.scratch, ignore_errors=True)
            self.scratch.mkdir(parents=True, exist_ok=True)  # a worker of a killed run may still write its last file
            (self.folder / "done").mkdir(exist_ok=True)
            write_whole(self.folder / "configuration.json", encode_json(self.configuration), self.scratch)
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock; finished objects stay."""
        self._held.close()

    def _check(self) -> None:
        existing = self._existing()
        others = {path.name for path in self.out.iterdir()} - {self.folder.name, ".lock"}
        if existing is None and others:
            found = ", ".join(sorted(others)[:3])
            raise DataError(self.out, "an empty folder or an unfinished data set", found, "name another one")
        if existing is not None and existing != self.configuration:
            was, now = (
                {_option(key): value for key, value in flattened(each).items()}
                for each in (existing, self.configuration)
            )
            changed = sorted(key for key in was | now if was.get(key) != now.get(key))
            held, wanted = (
                ", ".join(f"{key} {source.get(key)}" for key in changed[:_DIFFERENCES]) for source in (was, now)
            )
            more = f" and {len(changed) - _DIFFERENCES} more" if len(changed) > _DIFFERENCES else ""
            remedy = "name another folder"
            raise DataError(self.out, f"the data set it holds ({held}{more})", f"a request for {wanted}{more}", remedy)

    def done(self) -> dict[str, Entry]:
        """The finished objects, by name, whose files all match their checksums.

        Objects with missing files, or files emptied by a power failure, are rendered again.

        Returns:
            The record of each.
        """
        with malformed(self.out, "an unfinished data set"):
            return {
                name: entry
                for name, entry in self._entries().items()
                if all(_checksum(self.out, path) == checksum is not None for path, checksum in entry["files"].items())
            }

    def _entries(self) -> dict[str, Entry]:
        entries = {}
        manifest = self.out / MANIFEST
        if manifest.is_file():
            for name, record in read_json(manifest).get("objects", {}).items():
                files = record.pop("files", {})
                entries[name] = {"name": name, "record": record, "files": files}
        for path in sorted((self.folder / "done").glob("*.json")):
            with suppress(DataError):  # a record cut off by a power failure
                entries[path.stem] = read_json(path)
        return {name: entry for name, entry in entries.items() if isinstance(entry.get("files"), dict)}

    def remove(self, entry: Entry) -> None:
        """Delete the files of an object that is no longer in the data set."""
        for name in entry["files"]:
            path = inside(self.out, name, self.out / MANIFEST)
            path.unlink(missing_ok=True)
            with suppress(OSError):  # up to a folder that is not empty
                for folder in path.relative_to(self.out).parents[:-1]:
                    (self.out / folder).rmdir()

    def finish(self, manifest: dict[str, Any], others: dict[str, bytes]) -> None:
        """Write the manifest and other files, and remove the state of the work.

        All is flushed to the disk at once first: waiting for each of many small files would take longer than writing.

        Args:
            manifest: of the data set.
            others: further files of the layout, relative path to content.
        """
        os.sync()
        for name, content in others.items():
            write_whole(self.out / name, content, self.scratch)
        write_whole(self.out / MANIFEST, encode_json(manifest), self.scratch)
        with suppress(OSError):
            shutil.rmtree(self.folder)

    def _existing(self) -> dict[str, Any] | None:
        if (self.folder / "configuration.json").is_file():
            return read_json(self.folder / "configuration.json")
        if (self.out / MANIFEST).is_file():
            return read_json(self.out / MANIFEST).get("configuration", {})
        return None


def _option(key: str) -> str:
    """The option of `generate` that sets an entry of a configuration; for other entries, their name.

    >>> [_option(key) for key in ("field_of_view", "source.seed", "source.class_name", "generator")]
    ['--field-of-view', '--seed', '--class', 'generator']
    """
    others = {"generator": key, "source.class_name": "--class", "source.folder": "--meshes", "source.meshes": "meshes"}
    name = key.removeprefix("source.")
    return others.get(key) or (name if "." in name else f"--{name.replace('_', '-')}")
