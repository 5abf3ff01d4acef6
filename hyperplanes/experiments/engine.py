"""Runs an experiment: data, trainings and evaluations, each made once and kept in the output folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hyperplanes.adaptation.checkpoints import find_checkpoints, packaged_folder
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.configuration.presets import PROTOCOLS, Preset
from hyperplanes.data import open_dataset
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.data.support import WithBounds, WithSupport
from hyperplanes.evaluation import ObjectScore, Score, evaluate, merge_seeds
from hyperplanes.experiments.configurations import configuration, scaled_preset
from hyperplanes.experiments.experiment import Cell, Experiment, Trained
from hyperplanes.experiments.scales import Scale
from hyperplanes.methods import WithSampler, make_method
from hyperplanes.utilities.checkpoints import read_json
from hyperplanes.utilities.encoding import encode_json
from hyperplanes.utilities.files import write_json
from hyperplanes.views import Tasks

__all__ = ["Outcome", "Runner"]

Curve = list[dict[str, float]]


@dataclass(frozen=True)
class Outcome:
    """What an experiment has found.

    Attributes:
        experiment: what was run.
        scale: how large.
        scores: by (row, column), over all seeds.
        curves: of the trainings, by row and then by seed.
        seeds: how many.
        objects: trained on, by class.
    """

    experiment: Experiment
    scale: Scale
    scores: Mapping[tuple[str, str], Score]
    curves: Mapping[str, list[Curve]]
    seeds: int
    objects: Mapping[str, int]


class Runner:
    """Makes what is not made yet, in a folder that all experiments share.

    A data set lies in data/, a training in trainings/, an evaluation in evaluations/, under names that hold a checksum
    of everything that decides them: two experiments that need the same training share it, and after an interruption the
    same call goes on.

    Args:
        out: the folder.
        scale: how large.
        given: data sets by class, instead of generated ones.
        generate: called with a class and the folder its data set is to lie in; goes on where it stopped.
        train: called with a method's name, its configuration, the data, the folder of the checkpoint and that of the
            training it reads, if any; goes on where it was interrupted.
        say: called with a line about what is done.
        device: where to compute.
        legacy: as in `open_dataset`.
    """

    def __init__(
        self,
        out: Path,
        scale: Scale,
        *,
        given: Mapping[str, Path],
        generate: Callable[[str, Path], None],
        train: Callable[[str, Preset, Tasks, Path, Path | None], None],
        say: Callable[[str], None],
        device: torch.device,
        legacy: bool = False,
    ) -> None:
        self.legacy = legacy
        self.out, self.scale, self.given = out, scale, given
        self.generate, self.train, self.say, self.device = generate, train, say, device
        self._tasks: dict[str, TasksOnDevice] = {}

    def tasks(self, class_name: str) -> Tasks:
        """The data set of a class, generated where none was given; ValueError where the scale generates none."""
        if class_name not in self._tasks:
            data: Tasks = open_dataset(self.folder(class_name), legacy=self.legacy)
            if self.scale.bounds is not None:
                data = WithBounds(data, self.scale.bounds)
            self._tasks[class_name] = TasksOnDevice(data, self.device)
        return self._tasks[class_name]

    def folder(self, class_name: str) -> Path:
        """The folder of the data set of a class; as `tasks`."""
        if class_name in self.given:
            return self.given[class_name].resolve()
        scale = self.scale
        if scale.resolution is None:
            raise ValueError(
                f"data: expected --data {class_name}=FOLDER, as the scale {scale.name} takes data sets as they were "
                "published, got none; or take --scale small"
            )
        settings = {"class": class_name} | {
            name: getattr(scale, name) for name in ("resolution", "objects", "held_out", "views")
        }
        folder = self.out / "data" / _name(class_name, settings)
        if not (folder / "manifest.json").exists():
            self.generate(class_name, folder)
        return folder

    def names(self, class_name: str, split: str, most: int | None = None) -> list[str]:
        """The objects of a class that are evaluated, `most` at the most; ValueError where there are none."""
        tasks = self.tasks(class_name)
        found = list(tasks.names(split))
        if not found:
            raise ValueError(f"data: expected {class_name} objects in the {split} split, got none")
        if split == "train" and self.scale.held_out:  # as many as held-out ones
            found = found[: self.scale.held_out]
        return found[: self.scale.evaluated][:most]

    def run(self, experiment: Experiment, seeds: int) -> Outcome:
        """All trainings and evaluations of an experiment.

        Args:
            experiment: which.
            seeds: how many, from 0: each is that of a training and of the fine-tuning of its evaluations.

        Returns:
            All that tables and figures are made of.
        """
        scores: dict[tuple[str, str], list[Score]] = {}
        curves: dict[str, dict[tuple[str, int], Curve]] = {}
        for seed in range(seeds):
            for cell in experiment.cells:
                if cell.trained.packaged and seed:
                    continue  # the same whatever the seed
                folder = self.checkpoint(experiment, cell.trained, seed)
                state = folder / "training.json"  # none of a packaged model
                curve = read_json(state).get("curve", []) if state.exists() else []
                curves.setdefault(_curve_name(experiment, cell), {})[str(folder), seed] = curve
                score = self.score(experiment, cell, folder, seed)
                scores.setdefault((cell.row, cell.column), []).append(score)
        return Outcome(
            experiment,
            self.scale,
            {place: merge_seeds(found) for place, found in scores.items()},
            {name: list(found.values()) for name, found in curves.items()},
            seeds,
            {each.on: len(self.tasks(each.on).names("train")) for each in experiment.trainings},
        )

    def configuration(self, experiment: Experiment, trained: Trained, seed: int) -> Preset:
        """Model and training, as configured for the objects that there are."""
        objects = len(self.tasks(trained.on).names("train"))
        return configuration(experiment, trained, self.scale, objects, seed)

    def checkpoint(self, experiment: Experiment, trained: Trained, seed: int) -> Path:
        """The folder of a finished training, or of a packaged model."""
        if trained.packaged:
            return packaged_folder(trained.packaged)
        data = self.tasks(trained.on)
        chosen = self.configuration(experiment, trained, seed)
        reference = trained.reference and self.checkpoint(experiment, trained.reference, seed)
        settings = {
            "data": list(data.names("train")),
            "reference": "" if reference is None else reference.name,
            "method": trained.method,
            "model": chosen.model.as_json(),
            "training": asdict(chosen.training),
            "given": str(self.folder(trained.on)) if trained.on in self.given else "",
            **self._reading,
        }
        folder = self.out / "trainings" / _name(f"{self.folder(trained.on).name}-{trained.method}-{seed}", settings)
        state = folder / "training.json"
        if not state.exists() or read_json(state)["step"] < chosen.training.steps:
            self.say(
                f"training {trained.method} on {trained.on}, seed {seed}, {chosen.training.steps:,} steps: {folder}"
            )
            self.train(trained.method, chosen, self.arranged(trained, chosen), folder, reference)
        return folder

    def arranged(self, trained: Trained, chosen: Preset) -> Tasks:
        """The data of a training, with as many support views as its model has planes."""
        return WithSupport(self.tasks(trained.on), chosen.model.network.planes)

    def score(self, experiment: Experiment, cell: Cell, checkpoint: Path, seed: int) -> Score:
        """The evaluation of a cell with one seed, kept object by object."""
        method, made = self.scale.method(cell.method), None
        objects: list[ObjectScore] = []
        for name in self.names(cell.on, cell.split, experiment.objects):
            settings = {
                "checkpoint": checkpoint.name,
                "method": method,
                "on": str(self.folder(cell.on)) if cell.on in self.given else self.folder(cell.on).name,
                "object": name,
                "free": cell.free if method != cell.trained.method else "",
                "seed": seed,
                "views": self._views(cell, checkpoint),
                "fine_tuning": stated(self.fine_tuning(cell)),
                **self._reading,
            }
            path = self.out / "evaluations" / f"{_name(f'{self.folder(cell.on).name}-{method}-{seed}', settings)}.json"
            if not path.exists():
                made = made or self._method(experiment, cell, method, checkpoint, seed)
                score = evaluate(method, *made, [name])
                self.say(f"{cell.row}, {cell.column}, seed {seed}: {name} {score.mean('psnr'):.2f} dB")
                write_json(path, {"settings": settings, "score": score.as_json()})
            objects += Score.of_json(method, read_json(path)["score"]).objects
        return Score(method, tuple(objects))

    def picture(self, experiment: Experiment, cell: Cell, seed: int = 0) -> tuple[Tensor, Tensor]:
        """The first query view of the first object of a cell: the truth, and what the method shows; (3, h, w)."""
        checkpoint = self.checkpoint(experiment, cell.trained, seed)
        adapter, tasks = self._method(experiment, cell, self.scale.method(cell.method), checkpoint, seed)
        task = tasks.task(self.names(cell.on, cell.split, experiment.objects)[0])
        query = task.query[:1]
        return query.images[0], adapter.adapt(task.support).render(query.cameras).images[0].clamp(0, 1)

    def _method(
        self, experiment: Experiment, cell: Cell, method: str, checkpoint: Path, seed: int
    ) -> tuple[WithSampler, Tasks]:
        """The adapter of a cell, and the objects with as many support views as it shows."""
        checkpoints = find_checkpoints([checkpoint])
        trainable = cell.free if "hyperplanes" in checkpoints else "weights"
        settings = replace(self.fine_tuning(cell), trainable=trainable, seed=seed)
        tasks = WithSupport(self.tasks(cell.on), self._views(cell, checkpoint))
        adapter = make_method(
            method,
            checkpoints,
            device=self.device,
            settings=settings,
            preset=scaled_preset(experiment, self.scale),
        )
        sampling = None if cell.trained.packaged else PROTOCOLS[self.scale.protocol]
        return WithSampler(adapter, sampling), tasks

    @property
    def _reading(self) -> dict[str, Any]:
        """How data sets are read, where it is not the usual way."""
        bounds = self.scale.bounds
        stated_bounds = {} if bounds is None else {"bounds": asdict(bounds)}
        return ({"legacy": True} if self.legacy else {}) | stated_bounds

    def fine_tuning(self, cell: Cell) -> FineTuning:
        """Rays, optimiser and rates of the gradient steps of a cell; a learned initialisation states its own."""
        if cell.trained.method in LEARNED:
            return FineTuning()
        return self.scale.scratch if "_scratch_" in cell.method else self.scale.fine_tuning

    def _views(self, cell: Cell, checkpoint: Path) -> int:
        """How many support views a cell shows: as many as the model has planes, where it does not say."""
        if cell.views is not None:
            return self.scale.planes(cell.views)
        return int(read_json(checkpoint / "model.json")["network"]["planes"])


def stated(settings: FineTuning) -> dict[str, Any]:
    """What settings state otherwise than the defaults."""
    usual = asdict(FineTuning())
    return {name: value for name, value in asdict(settings).items() if value != usual[name]}


def _name(start: str, settings: Mapping[str, Any]) -> str:
    """A readable name with a checksum of what decides the content."""
    return f"{start}-{hashlib.sha256(encode_json(json.loads(json.dumps(settings)))).hexdigest()[:10]}"


def _curve_name(experiment: Experiment, cell: Cell) -> str:
    """What a training is called in a figure: the row or the column that tells it from others."""
    return cell.column if len(experiment.columns) > 1 else cell.row
