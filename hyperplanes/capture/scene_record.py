"""What `capture` wrote into a scene, so that other photographs and masks that were changed by hand are recognised."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperplanes.utilities.files.encoding import sha256
from hyperplanes.utilities.files.reading import DataError, read_json
from hyperplanes.utilities.files.writing import write_json

__all__ = ["SceneRecord", "checksums"]


def checksums(paths: Sequence[Path]) -> list[str]:
    """SHA-256 of each file.

    Args:
        paths: the files, which are not read into memory as a whole.
    """
    found = []
    for path in paths:
        with open(path, "rb") as file:
            found.append(hashlib.file_digest(file, "sha256").hexdigest())
    return found


@dataclass(frozen=True)
class SceneRecord:
    """The record of a scene.

    Attributes:
        folder: of the scene.
        path: the file of the record.
    """

    folder: Path
    path: Path

    def listed(self) -> set[str]:
        """The images and masks that transforms.json lists: images/NAME and masks/NAME."""
        frames = _read(self.folder / "transforms.json").get("frames")
        entries = [each for each in frames if isinstance(each, dict)] if isinstance(frames, list) else []
        names = [str(each[key]) for each in entries for key in ("file_path", "mask_path") if key in each]
        return {name for name in names if re.fullmatch(r"(images|masks)/[^/\\]+", name)}

    def check_photographs(self, sources: Collection[str], names: Collection[str]) -> None:
        """Check that a scene that is already there is of the same photographs.

        It is if one photograph at least is the same, so that others can be added and removed. Without a record, the
        names of the images are compared.

        Args:
            sources: the checksums of the photographs, or that of the video.
            names: of the images without suffix.

        Raises:
            DataError: no photograph of the scene is among them.
        """
        images = {Path(name).stem for name in self.listed() if name.startswith("images/")}
        recorded = self._photographs()
        former, given = (recorded, sources) if recorded else (images, names)
        if former and not set(former) & set(given):
            found = f"one of {len(images) or len(recorded)} others"
            raise DataError("--out", "a new folder or the scene of these photographs", found, "name another folder")

    def changed(self, new: Mapping[str, bytes]) -> list[str]:
        """The masks in the scene that differ from those that were last written, in the order of their names.

        Without a record, these are all masks.

        Args:
            new: files that will be written. Masks that are the same already are not returned.
        """
        written = self._masks()
        names = {name for name in self.listed() | set(new) | set(written) if name.startswith("masks/")}
        found = []
        for name in sorted(names):
            if (self.folder / name).is_file():
                data = (self.folder / name).read_bytes()
                if data != new.get(name) and sha256(data) not in written.get(name, ()):
                    found.append(name)
        return found

    def begin(self, sources: Collection[str], new: Mapping[str, bytes]) -> None:
        """Record files that will be written beside those that are there, so that this may be interrupted.

        Args:
            sources: as in `check_photographs`.
            new: the files.
        """
        masks = self._masks()
        self._write(sources, {name: [*masks.get(name, ()), *checks] for name, checks in _checks(new).items()}, masks)

    def finish(self, sources: Collection[str], new: Mapping[str, bytes]) -> None:
        """Record files that were written.

        Args:
            sources: as in `check_photographs`.
            new: the files.
        """
        self._write(sources, _checks(new), self._masks())

    def _write(self, sources: Collection[str], masks: dict[str, list[str]], former: dict[str, list[str]]) -> None:
        write_json(self.path, {"photographs": sorted(sources), "masks": former | masks})

    def _photographs(self) -> list[str]:
        found = _read(self.path).get("photographs")
        return [str(each) for each in found] if isinstance(found, list) else []

    def _masks(self) -> dict[str, list[str]]:
        found = _read(self.path).get("masks")
        return (
            {name: checks for name, checks in found.items() if isinstance(checks, list)}
            if isinstance(found, dict)
            else {}
        )


def _checks(files: Mapping[str, bytes]) -> dict[str, list[str]]:
    return {name: [sha256(data)] for name, data in files.items() if name.startswith("masks/")}


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_json(path)
    except DataError:
        return {}
