"""The scales at which an experiment is run: smoke, small, gpu and paper."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.experiments.paper.experiment import Cell, Experiment
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering.sampling.hierarchical import Hierarchical

__all__ = ["SCALES", "Scale"]

PAPER_VIEWS = 50


@dataclass(frozen=True)
class Scale:
    """The size of data, models and trainings of an experiment, compared with the paper's.

    Attributes:
        name: the name of the scale.
        presets: the names of presets by the size of the paper's images, in pixels along a side.
        protocol: how rays are sampled, a name in `presets.PROTOCOLS`.
        resolution: pixels along a side of generated images; None if data sets must be given.
        objects: generated objects per class, including the held-out ones.
        held_out: held-out objects per class.
        views: views per object, half support and half query views. Numbers of planes and of HyperPlanes are in
            proportion to it.
        steps: the steps of every training; None for the paper's epochs, each with one step per object.
        max_steps: most gradient steps on the support views of an object.
        max_curve_steps: most gradient steps in experiments that draw PSNR over the number of steps.
        evaluated: evaluated objects per class and split; None for all.
        most_seeds: the number of seeds of a table; None for as many as the paper has.
        changes: changes of the preset by dotted names, made before a method is chosen.
        learned: changes for learned initialisations, made after the method is chosen.
        learned_target: the field of learned initialisations; None for "nerf".
        fine_tuning: the settings of gradient steps on an object.
        scratch: the settings of gradient steps of a field from random weights.
        bounds: the sphere of every scene; None for that of the files or the masks.
        shown: the numbers of support views of the rows that are kept; None for all of them.
        packaged: whether to keep the rows of packaged models.
        data: by class, changed options of `generate`, and as `contents` the checksum of a folder that it reads, by
            `reading.folder_checksum`.
    """

    name: str
    presets: Mapping[int, str]
    protocol: str = "default"
    resolution: int | None = None
    objects: int = 0
    held_out: int = 0
    views: int = PAPER_VIEWS
    steps: int | None = None
    max_steps: int | None = None
    max_curve_steps: int | None = None
    evaluated: int | None = None
    most_seeds: int | None = None
    changes: Mapping[str, object] = field(default_factory=dict)
    learned: Mapping[str, object] = field(default_factory=dict)
    learned_target: str | None = None
    fine_tuning: FineTuning = field(default_factory=FineTuning)
    scratch: FineTuning = field(default_factory=FineTuning)
    bounds: Sphere | None = None
    shown: tuple[int, ...] | None = None
    packaged: bool = True
    data: Mapping[str, Mapping[str, object]] = field(default_factory=dict)

    def seeds(self, experiment: Experiment) -> int:
        """The number of seeds of an experiment: that of the scale, or that of the paper, which is 1 if not stated."""
        return (experiment.runs or 1) if self.most_seeds is None else self.most_seeds

    def applied(self, experiment: Experiment) -> Experiment:
        """The experiment with only those rows and numbers of steps that the scale allows."""
        kept = tuple(
            cell
            for cell in experiment.cells
            if (cell.views is None or self.shown is None or cell.views in self.shown)
            and (self.packaged or not cell.trained.packaged)
        )
        experiment = replace(experiment, cells=kept)
        if experiment.figure != "steps" or self.max_curve_steps is None:
            return experiment
        cells: dict[tuple[str, str], Cell] = {}
        for cell in experiment.cells:
            count = min(int(cell.column), self.max_curve_steps)
            method = cell.method.removesuffix(cell.column) + (str(count) if count else "")
            cells.setdefault((cell.row, str(count)), replace(cell, column=str(count), method=method))
        return replace(experiment, cells=tuple(cells.values()))

    def planes(self, count: int) -> int:
        """A number of planes of the paper, in proportion to the views per object."""
        return max(1, round(count * self.views / PAPER_VIEWS))

    def method(self, name: str) -> str:
        """The name of a method with its number of steps limited to `max_steps`.

        >>> SCALES["smoke"].method("hyperplanes_100")
        'hyperplanes_2'
        """
        match = re.fullmatch(r"(.+)_(\d+)", name)
        if match is None or self.max_steps is None or "_scratch_" in name:
            return name
        return f"{match[1]}_{min(int(match[2]), self.max_steps)}"


PUBLISHED_BOUNDS = Sphere((0.0, 0.0, 0.0), 2.0)
"""Near 2 and far 6 for cameras at a distance of 4, as in learnit and in the authors' code (`published.LEARNIT`)."""

AUTHORS_FINE_TUNING = FineTuning(
    "hypernetwork", 512, "adam", learning_rate=1e-4, final_rate_factor=1.0, betas=(0.9, 0.999), mask_views=False
)
"""The hypernetwork is optimised while the target is frozen, as the paper states, with the optimiser and the rates of
the authors' code (`published.CODE`)."""

NERF_TRAINING = FineTuning(
    "weights", 4096, "adam", learning_rate=5e-4, final_rate_factor=0.1, decay="exponential", betas=(0.9, 0.999)
)
"""The training of NeRF (Mildenhall et al. 2020, section 5.3): 4,096 rays, Adam with rates from 5e-4 to 5e-5 by
exponential decay."""

LEARNIT = {
    "model.network.depth": 5,
    "model.network.point_frequencies": 20,
    "model.coarse_network": False,
    "model.sampling": Hierarchical(128, 0),
    "training.steps": 100_000,
}
"""One network with five hidden layers and an output layer, 128 samples, 100,000 iterations (`published.LEARNIT`)."""

SCALES: dict[str, Scale] = {
    each.name: each
    for each in (
        Scale(
            name="smoke",
            presets={128: "quick", 200: "quick"},
            resolution=16,
            objects=4,
            held_out=2,
            views=8,
            steps=2,
            max_steps=2,
            max_curve_steps=3,
            evaluated=1,
            most_seeds=1,
            changes={
                "model.network.depth": 2,
                "model.network.width": 8,
                "model.hypernetwork.code": 4,
                "model.hypernetwork.depth": 1,
                "model.hypernetwork.width": 8,
                "autoencoder.code": 4,
                "autoencoder.latent": 4,
                "initialisation.inner_steps": 2,
                "initialisation.test_rays": 16,
                "model.sampling.steps": 8,
                "model.hull_resolution": 8,
                "training.tasks": 2,
                "training.rays": 16,
                "training.warmup": 0,
                "training.held_out": 1,
            },
            shown=(1, 25),
            packaged=False,
        ),
        Scale(
            name="small",
            presets={128: "quick", 200: "quick"},
            resolution=32,
            objects=50,
            held_out=10,
            steps=200,
            max_steps=150,
            max_curve_steps=1000,
            evaluated=10,
            most_seeds=3,
            changes={
                "model.network.depth": 3,
                "model.network.width": 64,
                "model.sampling.steps": 32,
                "model.hull_resolution": 32,
                "initialisation.inner_steps": 8,
                "initialisation.test_rays": 128,
                "training.tasks": 2,
                "training.rays": 128,
                "training.warmup": 20,
                "training.held_out": 2,
                "training.evaluate_every": 50,
                "training.checkpoint_every": 1000,
            },
            fine_tuning=FineTuning(rays=128),
            scratch=FineTuning(rays=128),
        ),
        Scale(
            name="gpu",
            presets={128: "paper-128", 200: "paper-200"},
            protocol="ray_marching",
            steps=5000,
            max_curve_steps=10_000,
            evaluated=5,
            most_seeds=1,
            changes={"training.evaluate_every": 500, "training.checkpoint_every": 1000},
            learned={
                "model.network.depth": 5,
                "model.network.point_frequencies": 20,
                "model.coarse_network": False,
                "training.steps": 2000,
            },
            learned_target="simplified_nerf",
            fine_tuning=AUTHORS_FINE_TUNING,
            scratch=NERF_TRAINING,
        ),
        Scale(
            name="paper",
            presets={128: "paper-128", 200: "paper-200"},
            protocol="paper",
            learned=LEARNIT,
            learned_target="simplified_nerf",
            fine_tuning=AUTHORS_FINE_TUNING,
            scratch=NERF_TRAINING,
            bounds=PUBLISHED_BOUNDS,
        ),
    )
}
"""The scales by the names that `hyperplanes reproduce --scale` takes."""
