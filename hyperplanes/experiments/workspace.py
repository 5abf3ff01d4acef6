"""The folder of an experiment with data sets, trainings and pages, each made once for the same settings."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hyperplanes.experiments.record import Record, plain
from hyperplanes.utilities.files.encoding import encode_json

__all__ = ["Workspace", "unique_name"]


class Workspace:
    """A folder in which work is done if it was not done before with the same settings; interrupted work is resumed.

    Args:
        out: the folder.
        places: the names of folders by class and by method, for a workspace with a single experiment. Results are in
            these folders, scores/ and pictures/, and those with other settings are removed. With None, results are in
            data/, trainings/ and evaluations/, which all experiments share.
        begin: called before each piece of work.
    """

    def __init__(
        self, out: Path, places: Mapping[str, str] | None = None, begin: Callable[[], None] = lambda: None
    ) -> None:
        self.out, self.places, self.begin = out, places, begin
        self.record = Record(out / "stages.json")

    def make(self, name: str, settings: Mapping[str, Any], outputs: Sequence[Path], work: Callable[[], object]) -> None:
        """Do a piece of work, unless it was done with these settings and its outputs are still there."""
        with self.making(name, settings, outputs) as needed:
            if needed:
                work()

    @contextmanager
    def making(self, name: str, settings: Mapping[str, Any], outputs: Sequence[Path]) -> Generator[bool]:
        """A context in which a piece of work is done, as in `make`; several contexts may overlap.

        Yields:
            Whether the work has to be done.
        """
        if self.record.done(name, settings, *outputs):
            yield False
            return
        self.begin()
        with self.record.working(name, settings, *outputs):
            yield True

    def folder(
        self, kind: str, place: str, name: str, settings: Mapping[str, Any], work: Callable[[Path], None]
    ) -> Path:
        """The folder of a data set or of a training, whose content is made if it was not made before.

        Args:
            kind: "data" or "trainings".
            place: the class or the method, the key in `places`.
            name: a unique name, as by `unique_name`.
            settings: all settings on which the content depends.
            work: makes the content; called with the folder.
        """
        with self.making_folder(kind, place, name, settings) as (folder, needed):
            if needed:
                work(folder)
        return folder

    @contextmanager
    def making_folder(
        self, kind: str, place: str, name: str, settings: Mapping[str, Any]
    ) -> Generator[tuple[Path, bool]]:
        """A context in which the content of a folder is made, as in `folder`; several contexts may overlap.

        Args:
            kind: as in `folder`.
            place: as in `folder`.
            name: as in `folder`.
            settings: as in `folder`.

        Yields:
            The folder, and whether its content has to be made.
        """
        path = self.path(kind, place, name)
        with self.making(path, {"name": name, **settings}, [self.out / path]) as needed:
            yield self.out / path, needed

    def has_folder(self, kind: str, place: str, name: str, settings: Mapping[str, Any]) -> bool:
        """Whether the content of a folder was made already."""
        path = self.path(kind, place, name)
        return self.record.done(path, {"name": name, **settings}, self.out / path)

    def path(self, kind: str, place: str, name: str) -> str:
        """The path of a folder relative to the workspace, which is also the name of its work in the record."""
        return f"{kind}/{name}" if self.places is None else self.places[place]


def unique_name(start: str, settings: Mapping[str, Any]) -> str:
    """A name with a checksum of the settings, from a readable start."""
    return f"{start}-{hashlib.sha256(encode_json(plain(settings))).hexdigest()[:10]}"
