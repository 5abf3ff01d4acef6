"""The trainings of experiments, each run once and kept in a workspace."""

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
from hyperplanes.experiments.paper.experiment import Experiment, Trained
from hyperplanes.experiments.workers import Workers
from hyperplanes.experiments.workspace import Workspace, unique_name
from hyperplanes.views import Tasks

__all__ = ["Train", "Trainings"]

Train = Callable[[Trained, Preset, Tasks, Path | None, Path], None]
"""A function that runs or resumes a training. Its arguments are the training, its configuration, the data, the folder
of the training that it reads, if any, and the folder of the checkpoint."""


class Trainings:
    """The trainings of experiments, each run once for the same settings.

    They are folders in a workspace, whose names contain a checksum of all settings on which they depend. So experiments
    that need the same training share it. To resume after an interruption, make the same call again.

    Args:
        workspace: the folder for all results.
        data: the data sets; they also have the scale.
        train: runs a training.
        workers: processes that run trainings side by side; with None, this process runs them.
    """

    def __init__(self, workspace: Workspace, data: DataSets, train: Train, workers: Workers | None) -> None:
        self.workspace, self.data, self.train, self.workers = workspace, data, train, workers

    def configuration(self, experiment: Experiment, trained: Trained, seed: int) -> Preset:
        """The configuration of a training for the number of objects in the data set."""
        objects = len(self.data.tasks(trained.on).names("train"))
        return configuration(experiment, trained, self.data.scale, objects, seed)

    def arranged(self, trained: Trained, chosen: Preset) -> Tasks:
        """The data of a training, with as many support views per object as its model has planes."""
        return WithSupport(self.data.tasks(trained.on), chosen.model.network.planes)

    def folder(self, experiment: Experiment, trained: Trained, seed: int) -> Path:
        """The checkpoint of a training, which is run if necessary, or of a packaged model."""
        if trained.packaged:
            return packaged_folder(trained.packaged)
        reference = trained.reference and self.folder(experiment, trained.reference, seed)

        def work(folder: Path) -> None:
            chosen = self.configuration(experiment, trained, seed)
            self.train(trained, chosen, self.arranged(trained, chosen), reference, folder)

        return self.workspace.folder(*self._place(experiment, trained, seed), work)

    def is_made(self, experiment: Experiment, trained: Trained, seed: int) -> bool:
        """Whether the training is done already."""
        return bool(trained.packaged) or self.workspace.has_folder(*self._place(experiment, trained, seed))

    def make_all(self, experiment: Experiment, seed: int, on_free: Callable[[], object] = lambda: None) -> None:
        """Run the trainings of an experiment, side by side if there are workers; those that read others come last.

        Each is recorded with its own duration when it ends.

        Args:
            experiment: the experiment.
            seed: the seed of the trainings.
            on_free: called when all trainings have begun, and whenever one of them ends while others still run.
        """
        if self.workers is not None:
            self._make_side_by_side(self.workers, experiment, seed, on_free)
        for trained in experiment.trainings:
            self.folder(experiment, trained, seed)

    def _make_side_by_side(
        self, workers: Workers, experiment: Experiment, seed: int, on_free: Callable[[], object]
    ) -> None:
        """Run the trainings that read no other training."""
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
                if len(running) == workers.count:  # a training that waits for a worker must not be timed
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
        """A unique name of a training, with a checksum, or the name of a packaged model."""
        if trained.packaged:
            return trained.packaged
        return self._named(trained, seed, self._settings(experiment, trained, seed))

    def _named(self, trained: Trained, seed: int, settings: dict[str, Any]) -> str:
        return unique_name(f"{Path(self.data.name(trained.on)).name}-{trained.method}-{seed}", settings)

    def _place(self, experiment: Experiment, trained: Trained, seed: int) -> tuple[str, str, str, dict[str, Any]]:
        """The arguments of `Workspace.folder` that identify the folder of a training."""
        settings = self._settings(experiment, trained, seed)
        return "trainings", trained.method, self._named(trained, seed, settings), settings

    def _settings(self, experiment: Experiment, trained: Trained, seed: int) -> dict[str, Any]:
        """All settings on which a training depends."""
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
    """The object of a worker process, `engine.Runner`."""

    trainings: Trainings


def _train(trained: Trained, chosen: Preset, folder: Path, runner: _HasTrainings) -> None:
    trainings = runner.trainings
    trainings.train(trained, chosen, trainings.arranged(trained, chosen), None, folder)
