"""The folder of an experiment: data sets, trainings and pages, each made once with the same settings."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hyperplanes.experiments.record import Record, plain
from hyperplanes.utilities.encoding import encode_json

__all__ = ["Workspace", "unique_name"]


class Workspace:
    """A folder in which what is not made yet is made, and what was interrupted goes on.

    Args:
        out: the folder.
        places: folders by class and by method, for an experiment that has the workspace for itself: results lie under
            these names, scores/ and pictures/, and those that were made with other settings are removed. Without it
            they lie in data/, trainings/ and evaluations/, which all experiments share.
        begin: called before anything is made.
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
        """The time in which a piece of work is done, as by `make`; several may overlap.

        Yields:
            Whether it is to be done: it was not yet.
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
        """The folder of a data set or of a training, which is made there unless it was.

        Args:
            kind: data or trainings.
            place: the class or the method, whose folder `places` gives.
            name: what tells it from others of its kind, as by `unique_name`.
            settings: all that decides its content.
            work: called with the folder.
        """
        with self.making_folder(kind, place, name, settings) as (folder, needed):
            if needed:
                work(folder)
        return folder

    @contextmanager
    def making_folder(
        self, kind: str, place: str, name: str, settings: Mapping[str, Any]
    ) -> Generator[tuple[Path, bool]]:
        """The time in which the folder of a data set or of a training is made, as by `folder`; several may overlap.

        Args:
            kind: as in `folder`.
            place: as in `folder`.
            name: as in `folder`.
            settings: as in `folder`.

        Yields:
            The folder, and whether it is to be made: it was not yet.
        """
        path = self.path(kind, place, name)
        with self.making(path, {"name": name, **settings}, [self.out / path]) as needed:
            yield self.out / path, needed

    def has_folder(self, kind: str, place: str, name: str, settings: Mapping[str, Any]) -> bool:
        """Whether `folder` would make nothing."""
        path = self.path(kind, place, name)
        return self.record.done(path, {"name": name, **settings}, self.out / path)

    def path(self, kind: str, place: str, name: str) -> str:
        """Where `folder` is, seen from the workspace; also what its work is recorded as."""
        return f"{kind}/{name}" if self.places is None else self.places[place]


def unique_name(start: str, settings: Mapping[str, Any]) -> str:
    """A readable name with a checksum of what decides the content."""
    return f"{start}-{hashlib.sha256(encode_json(plain(settings))).hexdigest()[:10]}"
