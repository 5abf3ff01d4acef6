"""Trains what experiments ask for: each training once, kept in a workspace."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, as_completed
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from hyperplanes.adaptation.checkpoints import packaged_folder
from hyperplanes.configuration.presets import Preset
from hyperplanes.data.support import WithSupport
from hyperplanes.experiments.configurations import configuration
from hyperplanes.experiments.data_sets import DataSets
from hyperplanes.experiments.experiment import Experiment, Trained
from hyperplanes.experiments.workers import Workers
from hyperplanes.experiments.workspace import Workspace, unique_name
from hyperplanes.views import Tasks

__all__ = ["Train", "Trainings"]

Train = Callable[[Trained, Preset, Tasks, Path | None, Path], None]
"""Called with what is trained, its configuration, the data, the folder of the training it reads, if any, and the folder
of the checkpoint; goes on where it was interrupted."""


class Trainings:
    """The trainings of experiments, each made once with the same settings.

    They lie in a workspace under names that hold a checksum of all that decides them: experiments that need the same
    training share it, and after an interruption the same call goes on.

    Args:
        workspace: the folder for everything.
        data: the data sets, and how large everything is.
        train: makes one.
        workers: processes in which they run side by side; this one where absent.
    """

    def __init__(self, workspace: Workspace, data: DataSets, train: Train, workers: Workers | None) -> None:
        self.workspace, self.data, self.train, self.workers = workspace, data, train, workers

    def configuration(self, experiment: Experiment, trained: Trained, seed: int) -> Preset:
        """Model and training, as configured for the objects that there are."""
        objects = len(self.data.tasks(trained.on).names("train"))
        return configuration(experiment, trained, self.data.scale, objects, seed)

    def arranged(self, trained: Trained, chosen: Preset) -> Tasks:
        """The data of a training, with as many support views as its model has planes."""
        return WithSupport(self.data.tasks(trained.on), chosen.model.network.planes)

    def folder(self, experiment: Experiment, trained: Trained, seed: int) -> Path:
        """The checkpoint of a training, which is made where it is not there, or of a packaged model."""
        if trained.packaged:
            return packaged_folder(trained.packaged)
        reference = trained.reference and self.folder(experiment, trained.reference, seed)
        chosen = self.configuration(experiment, trained, seed)
        work = partial(self.train, trained, chosen, self.arranged(trained, chosen), reference)
        return self.workspace.folder(*self._place(experiment, trained, seed), work)

    def is_made(self, experiment: Experiment, trained: Trained, seed: int) -> bool:
        """Whether `folder` would make nothing."""
        return bool(trained.packaged) or self.workspace.has_folder(*self._place(experiment, trained, seed))

    def make_all(self, experiment: Experiment, seed: int, on_free: Callable[[], object] = lambda: None) -> None:
        """The trainings of an experiment, side by side where there are workers; those that read others come later.

        Each is recorded, with its own duration, when it ends.

        Args:
            experiment: which.
            seed: of the trainings.
            on_free: called whenever workers have nothing left to begin with, as long as one still trains.
        """
        if self.workers is not None:
            self._make_side_by_side(self.workers, experiment, seed, on_free)
        for trained in experiment.trainings:
            self.folder(experiment, trained, seed)

    def _make_side_by_side(
        self, workers: Workers, experiment: Experiment, seed: int, on_free: Callable[[], object]
    ) -> None:
        """The trainings that read no other one."""
        running: dict[Future[None], ExitStack] = {}

        def finish_next() -> None:
            training = next(as_completed(running))
            recorded = running.pop(training)
            training.result()
            recorded.close()

        with ExitStack() as unfinished:
            for trained in experiment.trainings:
                if trained.packaged or trained.reference:
                    continue
                if len(running) == workers.count:  # one that waits takes no time
                    finish_next()
                recorded = unfinished.enter_context(ExitStack())
                making = self.workspace.making_folder(*self._place(experiment, trained, seed))
                folder, needed = recorded.enter_context(making)
                if needed:
                    work = partial(_train, trained, self.configuration(experiment, trained, seed), folder)
                    running[workers.submit({trained.on: self.data.folder(trained.on)}, work)] = recorded
            while running:
                on_free()
                finish_next()

    def name(self, experiment: Experiment, trained: Trained, seed: int) -> str:
        """What tells a training from others: the name of a packaged model, or one with a checksum."""
        if trained.packaged:
            return trained.packaged
        return self._named(trained, seed, self._settings(experiment, trained, seed))

    def _named(self, trained: Trained, seed: int, settings: dict[str, Any]) -> str:
        return unique_name(f"{Path(self.data.name(trained.on)).name}-{trained.method}-{seed}", settings)

    def _place(self, experiment: Experiment, trained: Trained, seed: int) -> tuple[str, str, str, dict[str, Any]]:
        """What `Workspace.folder` tells the folder of a training by."""
        settings = self._settings(experiment, trained, seed)
        return "trainings", trained.method, self._named(trained, seed, settings), settings

    def _settings(self, experiment: Experiment, trained: Trained, seed: int) -> dict[str, Any]:
        """All that decides a training."""
        chosen, reference = self.configuration(experiment, trained, seed), trained.reference
        return {
            "data": list(self.data.tasks(trained.on).names("train")),
            "reference": "" if reference is None else self.name(experiment, reference, seed),
            "method": trained.method,
            "model": chosen.model.as_json(),
            "training": asdict(chosen.training),
            "given": self.data.name(trained.on) if trained.on in self.data.given else "",
            **self.data.reading,
        }


class _HasTrainings(Protocol):
    """The runner of a worker process."""

    trainings: Trainings


def _train(trained: Trained, chosen: Preset, folder: Path, runner: _HasTrainings) -> None:
    trainings = runner.trainings
    trainings.train(trained, chosen, trainings.arranged(trained, chosen), None, folder)
