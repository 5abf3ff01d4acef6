"""Runs an experiment: data, trainings and evaluations, each made once and kept in the output folder."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hyperplanes.adaptation.base import Pictures
from hyperplanes.adaptation.checkpoints import find_checkpoints, packaged_folder
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.configuration.presets import PROTOCOLS, Preset
from hyperplanes.data import open_dataset
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.data.support import Shown, WithBounds, WithSupport
from hyperplanes.evaluation import ObjectScore, Score, evaluate, merge_seeds
from hyperplanes.experiments.configurations import configuration, scaled_preset
from hyperplanes.experiments.experiment import Cell, Experiment, Trained
from hyperplanes.experiments.record import Record, plain
from hyperplanes.experiments.scales import Scale
from hyperplanes.export.images import save_images
from hyperplanes.methods import WithSampler, make_method
from hyperplanes.utilities.checkpoints import read_json
from hyperplanes.utilities.encoding import encode_json
from hyperplanes.utilities.writing import write_json
from hyperplanes.views import Task, Tasks

__all__ = ["Curve", "OnScore", "Outcome", "Runner", "curve_of", "file_name"]

Curve = list[dict[str, float]]

OnScore = Callable[[Cell, int, ObjectScore, int, int], object]
"""Called with a cell, a seed, what was found of an object, how many of its objects are done, and how many there are."""


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
    """Makes what is not made yet, in a folder: data sets, trainings, evaluations, each once with the same settings.

    They lie in data/, trainings/ and evaluations/, under names that hold a checksum of everything that decides them:
    all experiments share a folder, two of them that need the same training share it, and after an interruption the
    same call goes on.

    Args:
        out: the folder.
        scale: how large.
        given: data sets by class, instead of generated ones.
        generate: called with what decides a data set and the folder it is to lie in; goes on where it stopped.
        train: called with what is trained, its configuration, the data, the folder of the training it reads, if any,
            and that of the checkpoint; goes on where it was interrupted.
        device: where to compute.
        legacy: as in `open_dataset`.
        places: folders by class and by method, for an experiment that has the folder for itself: results lie under
            these names, scores/ and pictures/, and those that were made with other settings are removed.
        begin: called before anything is made.
    """

    def __init__(
        self,
        out: Path,
        scale: Scale,
        *,
        generate: Callable[[Mapping[str, Any], Path], None],
        train: Callable[[Trained, Preset, Tasks, Path | None, Path], None],
        device: torch.device,
        given: Mapping[str, Path] | None = None,
        legacy: bool = False,
        places: Mapping[str, str] | None = None,
        begin: Callable[[], None] = lambda: None,
    ) -> None:
        self.out, self.scale, self.given, self.legacy = out, scale, given or {}, legacy
        self.generate, self.train, self.device, self.places, self.begin = generate, train, device, places, begin
        self.record = Record(out / "stages.json")
        self._tasks: dict[str, TasksOnDevice] = {}

    def make(self, name: str, settings: Mapping[str, Any], outputs: Sequence[Path], work: Callable[[], object]) -> None:
        """Do a piece of work, unless it was done with these settings and its outputs are still there."""
        if not self.record.done(name, settings, *outputs):
            self.begin()
            with self.record.working(name, settings, *outputs):
                work()

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
        settings = self._data_settings(class_name)
        return self._made("data", class_name, self.data_name(class_name), settings, partial(self.generate, settings))

    def data_name(self, class_name: str) -> str:
        """What tells the data set of a class from others: the folder of a given one, or a name with a checksum."""
        if class_name in self.given:
            return str(self.given[class_name].resolve())
        return _name(class_name, self._data_settings(class_name))

    def _data_settings(self, class_name: str) -> dict[str, Any]:
        scale = self.scale
        if scale.resolution is None:
            raise ValueError(
                f"data: expected --data {class_name}=FOLDER, as the scale {scale.name} takes data sets as they were "
                "published, got none; or take --scale small"
            )
        sizes = {name: getattr(scale, name) for name in ("resolution", "objects", "held_out", "views")}
        return {"class": class_name, **sizes, **scale.data.get(class_name, {})}

    def _made(
        self, kind: str, place: str, name: str, settings: Mapping[str, Any], work: Callable[[Path], None]
    ) -> Path:
        """The folder of a data set or of a training, which is made there unless it was."""
        path = f"{kind}/{name}" if self.places is None else self.places[place]
        folder = self.out / path
        self.make(path, {"name": name, **settings}, [folder], partial(work, folder))
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

    def run(self, experiment: Experiment, seeds: int, on_score: OnScore = lambda *_: None) -> Outcome:
        """All trainings and evaluations of an experiment.

        Args:
            experiment: which.
            seeds: how many, from 0: each is that of a training and of the fine-tuning of its evaluations.
            on_score: as in `score`.

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
                curves.setdefault(_curve_name(experiment, cell), {})[str(folder), seed] = curve_of(folder)
                scores.setdefault((cell.row, cell.column), []).append(self.score(experiment, cell, seed, on_score))
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
        reference = trained.reference and self.checkpoint(experiment, trained.reference, seed)
        chosen = self.configuration(experiment, trained, seed)
        data, name = self.arranged(trained, chosen), self.training_name(experiment, trained, seed)
        settings = self._training_settings(experiment, trained, seed)
        work = partial(self.train, trained, chosen, data, reference)
        return self._made("trainings", trained.method, name, settings, work)

    def training_name(self, experiment: Experiment, trained: Trained, seed: int) -> str:
        """What tells a training from others: the name of a packaged model, or one with a checksum."""
        if trained.packaged:
            return trained.packaged
        start = f"{Path(self.data_name(trained.on)).name}-{trained.method}-{seed}"
        return _name(start, self._training_settings(experiment, trained, seed))

    def _training_settings(self, experiment: Experiment, trained: Trained, seed: int) -> dict[str, Any]:
        """All that decides a training."""
        chosen, reference = self.configuration(experiment, trained, seed), trained.reference
        return {
            "data": list(self.tasks(trained.on).names("train")),
            "reference": "" if reference is None else self.training_name(experiment, reference, seed),
            "method": trained.method,
            "model": chosen.model.as_json(),
            "training": asdict(chosen.training),
            "given": self.data_name(trained.on) if trained.on in self.given else "",
            **self._reading,
        }

    def arranged(self, trained: Trained, chosen: Preset) -> Tasks:
        """The data of a training, with as many support views as its model has planes."""
        return WithSupport(self.tasks(trained.on), chosen.model.network.planes)

    def score(self, experiment: Experiment, cell: Cell, seed: int, on_score: OnScore = lambda *_: None) -> Score:
        """The evaluation of a cell with one seed, kept object by object.

        Args:
            experiment: which.
            cell: of it.
            seed: of the training and of fine-tuning.
            on_score: called after every object that was not evaluated before.
        """
        checkpoint = self.checkpoint(experiment, cell.trained, seed)
        method, made = self.scale.method(cell.method), None
        shared = {
            "checkpoint": self.training_name(experiment, cell.trained, seed),
            "method": method,
            "on": self.data_name(cell.on),
            "free": cell.trainable if method != cell.trained.method else "",  # as earlier versions named it
            "seed": seed,
            "views": self._views(cell, checkpoint),
            "fine_tuning": stated(self.fine_tuning(cell)),
            **({} if cell.query is None else {"query": cell.query}),
            **self._reading,
        }
        objects: list[ObjectScore] = []
        names = self.names(cell.on, cell.split, experiment.objects)
        for count, name in enumerate(names, 1):
            # what is known of the object, if it was found with the same settings
            settings = {**shared, "object": name}
            path, pictures = self._evaluation(cell, settings), self.pictures(cell, name)
            known = read_json(path) if path.exists() else {}
            whole = pictures.exists() or not experiment.keep_pictures
            # else the evaluation, its pictures first
            if known.get("settings") != plain(settings) or not whole:
                self.begin()
                made = made or self._method(experiment, cell, method, checkpoint, seed)
                keep = partial(_save_pictures, pictures) if experiment.keep_pictures else None
                score = evaluate(method, *made, [name], keep)
                known = {"settings": settings, "score": score.as_json()}
                on_score(cell, seed, score.objects[0], count, len(names))
                write_json(path, known)
            objects += Score.of_json(method, known["score"]).objects
        return Score(method, tuple(objects))

    def _evaluation(self, cell: Cell, settings: Mapping[str, Any]) -> Path:
        """The file of what a cell found of an object."""
        if self.places is not None:
            return self.out / "scores" / cell.column / file_name(cell.row) / f"{settings['object']}.json"
        start = f"{Path(settings['on']).name}-{settings['method']}-{settings['seed']}"
        return self.out / "evaluations" / f"{_name(start, settings)}.json"

    def pictures(self, cell: Cell, name: str) -> Path:
        """The folder of the query views of an object, as a cell shows them, where they are kept."""
        return self.out / "pictures" / cell.column / file_name(cell.row) / name

    def picture(self, experiment: Experiment, cell: Cell) -> tuple[Tensor, Tensor]:
        """The first query view of the first object of a cell: the truth, and what the method shows; (3, h, w)."""
        checkpoint = self.checkpoint(experiment, cell.trained, 0)
        adapter, tasks = self._method(experiment, cell, self.scale.method(cell.method), checkpoint, 0)
        task = tasks.task(self.names(cell.on, cell.split, experiment.objects)[0])
        query = task.query[:1]
        return query.images[0], adapter.adapt(task.support).render(query.cameras).images[0].clamp(0, 1)

    def _method(
        self, experiment: Experiment, cell: Cell, method: str, checkpoint: Path, seed: int
    ) -> tuple[WithSampler, Tasks]:
        """The adapter of a cell, and the objects with as many support views as it shows."""
        checkpoints = find_checkpoints([checkpoint])
        trainable = cell.trainable if "hyperplanes" in checkpoints else "weights"
        settings = replace(self.fine_tuning(cell), trainable=trainable, seed=seed)
        tasks, views = self.tasks(cell.on), self._views(cell, checkpoint)
        tasks = WithSupport(tasks, views) if cell.query is None else Shown(tasks, views, cell.query)
        names = self.names(cell.on, cell.split, experiment.objects)
        adapter = make_method(
            method,
            checkpoints,
            device=self.device,
            settings=settings,
            objects=(tasks.task(name).support for name in names),
            preset=scaled_preset(experiment, self.scale),
        )
        sampling = None if cell.trained.packaged else PROTOCOLS[self.scale.protocol]
        return WithSampler(adapter, sampling), tasks

    @property
    def _reading(self) -> dict[str, Any]:
        """How data sets are read, where it is not the usual way."""
        bounds = {} if self.scale.bounds is None else {"bounds": asdict(self.scale.bounds)}
        return ({"legacy": True} if self.legacy else {}) | bounds

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


def curve_of(checkpoint: Path) -> Curve:
    """What was measured while a model was trained; nothing of a packaged one."""
    state = checkpoint / "training.json"
    return read_json(state).get("curve", []) if state.exists() else []


def file_name(row: str) -> str:
    """The heading of a row in file names."""
    return row.replace(":", "-on-")


def _save_pictures(folder: Path, score: ObjectScore, task: Task, pictures: Pictures) -> None:
    save_images(pictures.images, folder, task.query.names)


def _name(start: str, settings: Mapping[str, Any]) -> str:
    """A readable name with a checksum of what decides the content."""
    return f"{start}-{hashlib.sha256(encode_json(plain(settings))).hexdigest()[:10]}"


def _curve_name(experiment: Experiment, cell: Cell) -> str:
    """What a training is called in a figure: the row or the column that tells it from others."""
    return cell.column if len(experiment.columns) > 1 else cell.row
