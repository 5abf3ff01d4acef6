"""An estimate of the time that an experiment will take, from a few measured steps of each of its trainings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.experiments.engine import Runner
from hyperplanes.experiments.paper.experiment import Experiment, Trained
from hyperplanes.geometry import cameras as camera
from hyperplanes.training import Trainer
from hyperplanes.training.initialisation import initialisation_trainer
from hyperplanes.utilities.machine.timing import clock
from hyperplanes.utilities.messages.formatting import format_duration, format_rate

__all__ = ["Estimate", "estimate"]

MEASURED_STEPS = 2  # measured steps, after one that is not measured
MEASURED_VIEW_SIZE = 32  # pixels along a side of the view that is rendered


@dataclass(frozen=True)
class Estimate:
    """The time of all trainings and evaluations of an experiment on this machine.

    Attributes:
        rows: one row of text per training.
        seconds: the time of everything.
    """

    rows: Sequence[tuple[str, ...]]
    seconds: float
    headings: ClassVar[tuple[str, ...]] = ("training", "steps", "rays/s", "to train", "to evaluate")


def estimate(runner: Runner, experiment: Experiment, seeds: int) -> Estimate:
    """Estimate the time of an experiment: take a few steps of every training and render a small view with its field.

    Args:
        runner: a runner with the data sets.
        experiment: the experiment.
        seeds: the number of seeds of every training and evaluation.

    Returns:
        The time of all trainings, including those that others read, and of all evaluations except those of packaged
        models. Work that is already done is included.
    """
    rows, whole = [], 0.0
    references = [each.reference for each in experiment.trainings if each.reference is not None]
    references = [each for each in references if each not in experiment.trainings]
    for trained in (*references, *experiment.trainings):
        if trained.packaged:
            continue
        chosen = runner.trainings.configuration(experiment, trained, 0)
        measured = _measure(runner, experiment, trained)
        training = measured.step * chosen.training.steps
        learned = chosen.model.initialisation
        evaluation = 0.0
        for cell in experiment.cells:
            if cell.trained == trained:
                names = runner.data.evaluated(cell.on, cell.split, experiment.objects)
                task = runner.data.tasks(cell.on).task(names[0])
                tuning = re.search(r"_(\d+)$", runner.scale.method(cell.method))
                tuned = runner.fine_tuning(cell).rays if learned is None else learned.test_rays
                rays = tuned * int(tuning[1]) if tuning else 0
                pixels = len(task.query) * task.query.size[0] * task.query.size[1]
                evaluation += len(names) * (rays / measured.rays_per_second + measured.pixel * pixels)
        rows.append(
            (
                f"{trained.method} on {trained.on}" + "".join(f", {n} {v}" for n, v in trained.changes.items()),
                f"{seeds} x {chosen.training.steps:,}",
                format_rate(measured.rays_per_second),
                format_duration(seeds * training),
                format_duration(seeds * evaluation),
            )
        )
        whole += seeds * (training + evaluation)
    return Estimate(rows, whole)


@dataclass(frozen=True)
class _Measured:
    """Seconds of a training step and of a rendered pixel, and the rays per second of training."""

    step: float
    pixel: float
    rays_per_second: float


def _measure(runner: Runner, experiment: Experiment, trained: Trained) -> _Measured:
    trainer = _trainer(runner, experiment, trained)
    trainer.loader.names = trainer.loader.names[: trainer.config.tasks]  # the first step prepares all of these
    trainer.take_step()
    started = clock()
    for _ in range(MEASURED_STEPS):
        trainer.take_step()
    step = (clock() - started) / MEASURED_STEPS
    task = trainer.data.task(trainer.loader.names[0])
    field = trainer.model.adapt(task.support)
    view = camera.resized(camera.select(task.query.cameras, [0]), MEASURED_VIEW_SIZE, MEASURED_VIEW_SIZE)
    field.render(view)  # the first call finds the occupied voxels, once per object
    started = clock()
    field.render(view)
    return _Measured(step, (clock() - started) / MEASURED_VIEW_SIZE**2, trainer.objective.rays_per_step / step)


def _trainer(runner: Runner, experiment: Experiment, trained: Trained) -> Trainer:
    """A training that is never saved."""
    chosen = runner.trainings.configuration(experiment, trained, 0)
    model, data = HyperPlanes(chosen.model).to(runner.device), runner.trainings.arranged(trained, chosen)
    if chosen.model.initialisation is None:
        return Trainer(model, data, chosen.training)
    reference = trained.reference and _trainer(runner, experiment, trained.reference).model
    return initialisation_trainer(model, data, chosen.training, None, reference)
