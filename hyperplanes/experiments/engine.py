"""Runs an experiment: its trainings, and the evaluations of their models. The results are kept in a workspace."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hyperplanes.adaptation.base import Pictures, Renderable
from hyperplanes.adaptation.checkpoints import find_checkpoints
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.data.support import FarthestSupport, WithSupport
from hyperplanes.evaluation import ObjectScore, Score, evaluate, merge_seeds
from hyperplanes.experiments.configurations import scaled_preset
from hyperplanes.experiments.data_sets import DataSets
from hyperplanes.experiments.paper.experiment import Cell, Experiment
from hyperplanes.experiments.paper.scales import Scale
from hyperplanes.experiments.record import plain
from hyperplanes.experiments.trainings import Train, Trainings
from hyperplanes.experiments.workers import Result, Workers
from hyperplanes.experiments.workspace import Workspace, unique_name
from hyperplanes.export.images import orbit_cameras, picture_paths, save_images
from hyperplanes.methods import Request, Unchecked, make_method
from hyperplanes.utilities.files.checkpoints import read_json
from hyperplanes.utilities.files.writing import write_json
from hyperplanes.utilities.machine.environment import find_processor
from hyperplanes.views import Task, Tasks

__all__ = ["ORBIT", "Curve", "OnScore", "Outcome", "Runner", "curve_of", "file_name"]

ORBIT = "orbit"  # folder, among the pictures of an object, of views on a circle around it

Curve = list[dict[str, float]]

OnScore = Callable[[Cell, int, ObjectScore, int, int], object]
"""Called with a cell, a seed, the score of an object, and the number of the cell's objects that are done and in all."""


@dataclass(frozen=True)
class Outcome:
    """The results of an experiment.

    Attributes:
        experiment: the experiment.
        scale: its scale.
        scores: the scores by (row, column), over all seeds.
        curves: the curves of the trainings by row, or by column if there are several, one per seed.
        seeds: the number of seeds.
        objects: the number of training objects by class; empty if every model is packaged.
        given: the classes whose data sets were given, not generated.
    """

    experiment: Experiment
    scale: Scale
    scores: Mapping[tuple[str, str], Score]
    curves: Mapping[str, list[Curve]]
    seeds: int
    objects: Mapping[str, int]
    given: Sequence[str] = ()


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one object by the method of a cell, with the checkpoint and the seed."""

    experiment: Experiment
    cell: Cell
    checkpoint: Path
    seed: int
    name: str


class Runner:
    """Runs the trainings and evaluations of experiments, each once for the same settings.

    Evaluations are files in a workspace, whose names contain a checksum of all settings on which they depend. To resume
    after an interruption, make the same call again.

    Args:
        workspace: the folder for all results.
        data: the data sets; they also have the scale.
        train: runs a training.
        device: the device to compute on.
        workers: processes that run trainings side by side and evaluate objects; by default this process does so.
    """

    def __init__(
        self,
        workspace: Workspace,
        data: DataSets,
        *,
        train: Train,
        device: torch.device,
        workers: Workers | None = None,
    ) -> None:
        self.workspace, self.data, self.scale, self.device = workspace, data, data.scale, device
        self.workers = workers
        self.trainings = Trainings(workspace, data, train, workers)
        self._evaluated: dict[Path, Future[ObjectScore]] = {}  # evaluations by workers, by their files
        self._method_in_use: tuple[object, tuple[Unchecked, Tasks]] | None = None

    def run(self, experiment: Experiment, seeds: int, on_score: OnScore = lambda *_: None) -> Outcome:
        """Run all trainings and evaluations of an experiment.

        Args:
            experiment: the experiment.
            seeds: the number of seeds, from 0. Each is the seed of a training and of the fine-tuning of its model.
            on_score: as in `score`.

        Returns:
            The results, for tables and figures.
        """
        scores: dict[tuple[str, str], list[Score]] = {}
        curves: dict[str, dict[tuple[str, int], Curve]] = {}
        for seed in range(seeds):
            self.train_all(experiment, seed, [experiment])
            self.start(experiment, seed)
            for cell in experiment.cells:
                if cell.trained.packaged and seed:
                    continue  # a packaged model does not depend on the seed
                folder = self.trainings.folder(experiment, cell.trained, seed)
                curves.setdefault(_curve_name(experiment, cell), {})[str(folder), seed] = curve_of(folder)
                scores.setdefault((cell.row, cell.column), []).append(self.score(experiment, cell, seed, on_score))
        return Outcome(
            experiment,
            self.scale,
            {place: merge_seeds(found) for place, found in scores.items()},
            {name: list(found.values()) for name, found in curves.items()},
            seeds,
            {e.on: len(self.data.tasks(e.on).names("train")) for e in experiment.trainings if not e.packaged},
            [each for each in experiment.classes if each in self.data.given],
        )

    def train_all(self, experiment: Experiment, seed: int, evaluated: Sequence[Experiment] = ()) -> None:
        """Run the trainings of an experiment. Workers that have nothing left to train begin with evaluations.

        Args:
            experiment: the experiment.
            seed: the seed of the trainings.
            evaluated: the experiments of these evaluations, as in `start`.
        """
        self.trainings.make_all(experiment, seed, lambda: [self.start(each, seed) for each in evaluated])

    def score(self, experiment: Experiment, cell: Cell, seed: int, on_score: OnScore = lambda *_: None) -> Score:
        """The score of a cell with one seed. The score of each object is written to a file.

        Args:
            experiment: the experiment.
            cell: a cell of it.
            seed: the seed of the training and of fine-tuning.
            on_score: called after every object that was not evaluated before.
        """
        objects: list[ObjectScore] = []
        method, names = self.scale.method(cell.method), self.data.evaluated(cell.on, cell.split, experiment.objects)
        for count, (job, settings, path, known) in enumerate(self._evaluations(experiment, cell, seed), 1):
            if known is None:
                self.workspace.begin()
                if _is_time(cell):
                    wait(self._evaluated.values())  # running workers would slow down what is measured
                started = self._evaluated.pop(path, None)
                found = self.evaluate(job) if started is None else started.result()
                known = Score(method, (found,))
                on_score(cell, seed, found, count, len(names))
                write_json(path, {"settings": settings, "score": known.as_json()})
            objects += known.objects
        return Score(method, tuple(objects))

    def start(self, experiment: Experiment, seed: int) -> None:
        """Let the workers, if any, begin the evaluations for `score` of those models whose training is done.

        Cells whose quantity is a time are evaluated by this process, while no worker is running.
        """
        if self.workers is None:
            return
        for cell in experiment.cells:
            if _is_time(cell) or not self.trainings.is_made(experiment, cell.trained, seed):
                continue
            for job, _, path, known in self._evaluations(experiment, cell, seed):
                if known is None and path not in self._evaluated:
                    self._evaluated[path] = self.workers.submit(self._folders(cell.on), partial(_evaluate, job))

    def do_all(self, class_name: str, works: Sequence[Callable[[Runner], Result]]) -> list[Result]:
        """The results of functions, which run side by side if there are workers.

        Args:
            class_name: the class of the data set that they read.
            works: functions of the runner of their process; they are pickled if there are workers.
        """
        if self.workers is None:
            return [work(self) for work in works]
        started = [self.workers.submit(self._folders(class_name), work) for work in works]
        return [each.result() for each in started]

    def _evaluations(
        self, experiment: Experiment, cell: Cell, seed: int
    ) -> Generator[tuple[Evaluation, dict[str, Any], Path, Score | None]]:
        """For every object of a cell: the evaluation, all settings of it, its file, and the score if that is known."""
        checkpoint = self.trainings.folder(experiment, cell.trained, seed)
        method = self.scale.method(cell.method)
        shared = {
            "checkpoint": self.trainings.name(experiment, cell.trained, seed),
            "method": method,
            "on": self.data.name(cell.on),
            "trainable": cell.trainable if method != cell.trained.method else "",
            "seed": seed,
            "views": self._views(cell, checkpoint),
            "fine_tuning": stated(self.fine_tuning(cell)),
            **({} if cell.query is None else {"query": cell.query}),
            **({"orbit": cell.orbit} if cell.orbit else {}),
            **({"measured_alone": self._measured_by()} if _is_time(cell) else {}),
            **self.data.reading,
        }
        for name in self.data.evaluated(cell.on, cell.split, experiment.objects):
            settings = {**shared, "object": name}
            path, whole = self._evaluation(cell, settings), True
            if experiment.keep_pictures:
                folder = self.pictures(cell, name)
                whole = folder.exists() and all(each.exists() for each in picture_paths(cell.orbit, folder / ORBIT))
            known = read_json(path) if path.exists() else {}
            found = known.get("settings") == plain(settings) and whole
            score = Score.of_json(method, known["score"]) if found else None
            yield Evaluation(experiment, cell, checkpoint, seed, name), settings, path, score

    def evaluate(self, job: Evaluation) -> ObjectScore:
        """The score of one object by the method of a cell. If the experiment keeps pictures, they are written."""
        experiment, cell = job.experiment, job.cell
        made_for = (experiment.name, cell, job.checkpoint, job.seed)
        method = self.scale.method(cell.method)
        if self._method_in_use is None or self._method_in_use[0] != made_for:
            self._method_in_use = made_for, self._method(experiment, cell, method, job.checkpoint, job.seed)
        keep = partial(_save_pictures, self.pictures(cell, job.name), cell) if experiment.keep_pictures else None
        return evaluate(method, *self._method_in_use[1], [job.name], keep).objects[0]

    def _measured_by(self) -> dict[str, Any]:
        """The device and the number of threads of this process, on which measured times depend."""
        on_gpu = self.device.type == "cuda"
        name = torch.cuda.get_device_name(self.device) if on_gpu else find_processor()
        return {"device": name, "threads": torch.get_num_threads()}

    def _folders(self, class_name: str) -> dict[str, Path]:
        """The folder of the data set of a class, for a worker, because workers do not generate data sets."""
        return {class_name: self.data.folder(class_name)}

    def _evaluation(self, cell: Cell, settings: Mapping[str, Any]) -> Path:
        """The file of the score of an object in a cell."""
        if self.workspace.places is not None:
            return self.workspace.out / "scores" / cell.column / file_name(cell.row) / f"{settings['object']}.json"
        start = f"{Path(settings['on']).name}-{settings['method']}-{settings['seed']}"
        return self.workspace.out / "evaluations" / f"{unique_name(start, settings)}.json"

    def pictures(self, cell: Cell, name: str) -> Path:
        """The folder of the rendered query views of an object in a cell, for experiments that keep pictures.

        Views on a circle are in its folder ORBIT.
        """
        return self.workspace.out / "pictures" / cell.column / file_name(cell.row) / name

    def picture(self, experiment: Experiment, cell: Cell) -> tuple[Tensor, Tensor]:
        """The first query view of the first object of a cell: the true image and the method's picture, (3, h, w)."""
        checkpoint = self.trainings.folder(experiment, cell.trained, 0)
        adapter, tasks = self._method(experiment, cell, self.scale.method(cell.method), checkpoint, 0)
        task = tasks.task(self.data.evaluated(cell.on, cell.split, experiment.objects)[0])
        query = task.query[:1]
        return query.images[0], adapter.adapt(task.support).render(query.cameras).images[0].clamp(0, 1)

    def _method(
        self, experiment: Experiment, cell: Cell, method: str, checkpoint: Path, seed: int
    ) -> tuple[Unchecked, Tasks]:
        """The adapter of a cell, and the objects with the cell's number of support views."""
        checkpoints = find_checkpoints([checkpoint])
        trainable = cell.trainable if "hyperplanes" in checkpoints else "weights"
        settings = replace(self.fine_tuning(cell), trainable=trainable, seed=seed)
        tasks, views = self.data.tasks(cell.on), self._views(cell, checkpoint)
        tasks = WithSupport(tasks, views) if cell.query is None else FarthestSupport(tasks, views, cell.query)
        names = self.data.evaluated(cell.on, cell.split, experiment.objects)
        request = Request(
            method,
            checkpoints,
            device=self.device,
            settings=settings,
            objects=(tasks.task(name).support for name in names),
            preset=scaled_preset(experiment, self.scale),
        )
        return Unchecked(make_method(request)), tasks

    def fine_tuning(self, cell: Cell) -> FineTuning:
        """The settings of the gradient steps of a cell. A learned initialisation has its own and gets the defaults.

        If the scale has settings for the hypernetwork alone, cells that fine-tune all weights get the defaults, as in
        `render`.
        """
        for_all_weights = self.scale.fine_tuning.trainable == "weights"
        if cell.trained.method in LEARNED or (cell.trainable == "weights" and not for_all_weights):
            return FineTuning()
        return self.scale.scratch if "_scratch_" in cell.method else self.scale.fine_tuning

    def _views(self, cell: Cell, checkpoint: Path) -> int:
        """The number of support views of a cell; by default the number of planes of the model."""
        if cell.views is not None:
            return self.scale.planes(cell.views)
        return int(read_json(checkpoint / "model.json")["network"]["planes"])


def stated(settings: FineTuning) -> dict[str, Any]:
    """The settings that differ from the defaults, by name."""
    usual = asdict(FineTuning())
    return {name: value for name, value in asdict(settings).items() if value != usual[name]}


def curve_of(checkpoint: Path) -> Curve:
    """The curve of the training of a model; empty for a packaged model."""
    state = checkpoint / "training.json"
    return read_json(state).get("curve", []) if state.exists() else []


def file_name(row: str) -> str:
    """The name of a folder for the heading of a row."""
    return row.replace(":", "-on-")


def _is_time(cell: Cell) -> bool:
    """Whether the quantity of a cell is a time, which is measured in this process while no worker is running."""
    return cell.quantity.endswith("seconds")


def _evaluate(job: Evaluation, runner: Runner) -> ObjectScore:
    return runner.evaluate(job)


def _save_pictures(
    folder: Path, cell: Cell, score: ObjectScore, task: Task, pictures: Pictures, adapted: Renderable
) -> None:
    if cell.orbit:
        save_images(adapted.render(orbit_cameras(task.support, cell.orbit)).images, folder / ORBIT)
    save_images(pictures.images, folder, task.query.names)


def _curve_name(experiment: Experiment, cell: Cell) -> str:
    """The name of a training in a figure: its column if there are several, otherwise its row."""
    return cell.column if len(experiment.columns) > 1 else cell.row
