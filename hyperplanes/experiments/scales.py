"""How large an experiment is run: smoke, small or paper."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hyperplanes.experiments.tables import Cell, Experiment

__all__ = ["SCALES", "Scale"]

PAPER_VIEWS = 50


@dataclass(frozen=True)
class Scale:
    """What is taken from the paper's setting and what is made smaller.

    Attributes:
        name: of the scale.
        about: one line.
        presets: of the configuration, by the paper's pixels a side.
        protocol: how rays are sampled, a name in `presets.PROTOCOLS`.
        resolution: pixels a side of generated images; None where data must be given.
        objects: generated a class, the held-out ones included.
        held_out: of them.
        views: an object, half support and half query. ArrayLike of planes and of HyperPlanes are in proportion to it.
        steps: of every training; None for the paper's epochs, a step an object.
        tuning: the most gradient steps on the support views of an object.
        longest: the same where PSNR is drawn over their number.
        evaluated: objects a class and split; None for all.
        trainings: about as many a table; where one seed of all models takes fewer, more seeds are run.
        changes: of the configuration, by dotted names, for every model.
    """

    name: str
    about: str
    presets: Mapping[int, str]
    protocol: str
    resolution: int | None
    objects: int
    held_out: int
    views: int
    steps: int | None
    tuning: int | None
    longest: int | None
    evaluated: int | None
    trainings: int | None
    changes: Mapping[str, object] = field(default_factory=dict)

    def seeds(self, experiment: Experiment) -> int:
        """How many seeds of an experiment are run; never more than in the paper."""
        if self.trainings is None:
            return experiment.runs
        return min(experiment.runs, max(1, self.trainings // len(experiment.trainings)))

    def applied(self, experiment: Experiment) -> Experiment:
        """The experiment with columns of so many steps only as the scale allows, where columns are numbers of steps."""
        if experiment.figure != "steps" or self.longest is None:
            return experiment
        cells: dict[tuple[str, str], Cell] = {}
        for cell in experiment.cells:
            count = min(int(cell.column), self.longest)
            method = cell.method.removesuffix(cell.column) + (str(count) if count else "")
            cells.setdefault((cell.row, str(count)), replace(cell, column=str(count), method=method))
        return replace(experiment, cells=tuple(cells.values()))

    def planes(self, count: int) -> int:
        """A number of the paper's planes, in proportion to the views an object."""
        return max(1, round(count * self.views / PAPER_VIEWS))

    def method(self, name: str) -> str:
        """A method with at most as many steps as the scale allows.

        >>> SCALES["smoke"].method("hyperplanes_100")
        'hyperplanes_2'
        """
        match = re.fullmatch(r"(.+)_(\d+)", name)
        if match is None or self.tuning is None or "_scratch_" in name:
            return name
        return f"{match[1]}_{min(int(match[2]), self.tuning)}"


SCALES: dict[str, Scale] = {
    each.name: each
    for each in (
        Scale(
            "smoke",
            "seconds: that everything runs; nothing is learnt",
            {128: "quick", 200: "quick"},
            "default",
            16,
            4,
            2,
            8,
            2,
            2,
            3,
            1,
            1,
            {
                "model.network.depth": 2,
                "model.network.width": 8,
                "model.hypernetwork.code": 4,
                "model.hypernetwork.depth": 1,
                "model.hypernetwork.width": 8,
                "model.autoencoder.code": 4,
                "model.autoencoder.latent": 4,
                "model.initialisation.inner_steps": 2,
                "model.initialisation.test_rays": 16,
                "model.sampling.steps": 8,
                "model.hull_resolution": 8,
                "training.tasks": 2,
                "training.rays": 16,
                "training.warmup": 0,
                "training.held_out": 1,
            },
        ),
        Scale(
            "small",
            "one to a few hours on two cores: 64x64, procedural objects",
            {128: "quick", 200: "quick"},
            "default",
            64,
            105,
            5,
            50,
            800,
            2000,
            10_000,
            None,
            15,
        ),
        Scale(
            "paper",
            "the paper's setting on data sets as they were published, on a GPU",
            {128: "paper-128", 200: "paper-200"},
            "paper",
            None,
            0,
            0,
            50,
            None,
            None,
            None,
            None,
            None,
        ),
    )
}
"""By the names that `hyperplanes reproduce --scale` takes."""
