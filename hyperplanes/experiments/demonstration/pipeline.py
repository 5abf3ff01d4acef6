"""The demonstration: what it is made of, and each of its stages as a function."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from hyperplanes.adaptation.base import Adapter, Pictures
from hyperplanes.configuration.presets import Preset, configure
from hyperplanes.data.devices import TasksOnDevice, choose_device
from hyperplanes.evaluation import ObjectScore, evaluate
from hyperplanes.experiments.demonstration.first_page import COUNTS
from hyperplanes.experiments.stages import Stage
from hyperplanes.export.images import save_images
from hyperplanes.methods import at_steps, describe_method, make_method
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.checkpoints import read_json
from hyperplanes.utilities.files import write_json
from hyperplanes.views import Task, Tasks

__all__ = [
    "FIRST",
    "MODELS",
    "TUNED",
    "DemoSettings",
    "describe_row",
    "file_name",
    "measure_tuning",
    "configurations",
    "score_method",
    "stages",
    "write_metrics",
]

TUNED = ("hyperplanes", "scratch")
"""Methods whose PSNR over fine-tuning steps is drawn."""

FIRST = "packaged model"
"""The stage that shows what needs no training."""

CLASSES = ("car", "chair", "plane", "lamp")

MODELS = ("hyperplanes", "point_multiplane")
"""What is trained, each into a folder of its name."""


@dataclass(frozen=True)
class DemoSettings:
    """How large the demonstration is.

    Attributes:
        class_name: of the procedural objects.
        objects: how many, the held-out ones included.
        held_out: of them.
        resolution: pixels a side.
        views: an object, half support and half query.
        preset: what is trained.
        steps: other than the preset's.
        seed: of everything.
        exhibits: objects shown in the report.
        frames: of each turntable.
        unseen_objects: of another class, which no model is trained on.
        fine_tuned: numbers of fine-tuning steps of the rows of the table, a few and many.
        tuning: numbers of fine-tuning steps in the chart of fine-tuning.
        tuned_objects: held-out objects that it is drawn of.
        first: classes of which the packaged model shows one object each, before anything is trained.
        first_resolution: of their images.
        first_counts: numbers of views that it is shown of each.
        meshes: a folder of mesh files that it shows too.
        tiny: networks so small that nothing is learnt: to see that everything runs.
    """

    class_name: str = "car"
    objects: int = 155
    held_out: int = 5
    resolution: int = 64
    views: int = 50
    preset: str = "quick"
    steps: int | None = 800
    seed: int = 0
    exhibits: int = 5
    frames: int = 36
    unseen_objects: int = 2
    fine_tuned: tuple[int, int] = (10, 100)
    tuning: tuple[int, ...] = (0, 1, 3, 10, 30, 100, 300)
    tuned_objects: int = 1
    first: tuple[str, ...] = CLASSES
    first_resolution: int = 128
    first_counts: tuple[int, ...] = COUNTS
    meshes: Path | None = None
    tiny: bool = False

    @property
    def unseen_class(self) -> str:
        """The class of the objects that no model is trained on."""
        return "car" if self.class_name == "chair" else "chair"

    @property
    def methods(self) -> tuple[str, ...]:
        """The rows of the table on the class that was trained on."""
        few, many = self.fine_tuned
        tuned = (f"hyperplanes_{few}", f"hyperplanes_{many}", f"scratch_{many}")
        return ("nearest_view", "point_multiplane", "hyperplanes_swapped", "hyperplanes", *tuned)

    @property
    def rows(self) -> tuple[str, ...]:
        """All rows of the table: `methods`, and METHOD:CLASS for those on the class that was never trained on."""
        many = self.fine_tuned[1]
        unseen = ("nearest_view", "hyperplanes", f"hyperplanes_{many}", f"scratch_{many}")
        return (*self.methods, *(f"{method}:{self.unseen_class}" for method in unseen))

    @classmethod
    def quick_check(cls, seed: int = 0) -> DemoSettings:
        """A demonstration of seconds that shows nothing but that it runs."""
        return cls(
            objects=4,
            held_out=2,
            resolution=24,
            views=12,
            steps=20,
            seed=seed,
            exhibits=1,
            frames=6,
            unseen_objects=1,
            fine_tuned=(1, 2),
            tuning=(0, 2, 5),
            tuned_objects=1,
            first=("car", "lamp"),
            first_resolution=24,
            first_counts=(3, 8),
            tiny=True,
        )


def configurations(settings: DemoSettings) -> dict[str, Preset]:
    """Model and training of each of MODELS."""
    chosen = {name: configure(settings.preset, name, steps=settings.steps, seed=settings.seed) for name in MODELS}
    return {name: _tiny(one, settings.views) for name, one in chosen.items()} if settings.tiny else chosen


def _tiny(chosen: Preset, views: int) -> Preset:
    model, planes = chosen.model, views // 2
    hyper = model.hypernetwork
    return replace(
        chosen,
        model=replace(
            model,
            network=replace(model.network, depth=2, width=16, planes=planes),
            hypernetwork=hyper and replace(hyper, views=min(3, planes), code=8, depth=1, width=16),
            sampling=RayMarching(steps=16),
            hull_resolution=16,
        ),
        training=replace(chosen.training, rays=32, warmup=0, checkpoint_every=10),
    )


def stages(settings: DemoSettings) -> list[Stage]:
    """The stages in their order, each with all that decides its result."""
    described = json.loads(json.dumps(asdict(settings), default=str))
    deciding = ("class_name", "objects", "held_out", "unseen_objects", "resolution", "views", "seed")
    data = {key: described[key] for key in deciding}
    first = {key: described[key] for key in ("first", "first_resolution", "first_counts", "meshes", "seed", "frames")}
    result = [Stage(FIRST, first, ["first", "first.html"]), Stage("data", data, ["data", "unseen"])]
    models: dict[str, Any] = {}
    for name, chosen in configurations(settings).items():
        models[name] = {"model": chosen.model.as_json(), "training": asdict(chosen.training)}
        own = json.loads(json.dumps({"data": data, **models[name]}))
        result.append(Stage(name, own, [name]))
    everything = json.loads(json.dumps({"data": data, "models": models}))
    for name in settings.rows:
        file = file_name(name)
        result.append(Stage(f"evaluate {name}", everything, [f"scores/{file}.json", f"pictures/{file}"]))
    tuning = {key: described[key] for key in ("tuning", "tuned_objects")}
    result.append(Stage("fine-tuning", {**everything, **tuning}, ["tuning.json"]))
    shown = {"exhibits": settings.exhibits, "frames": settings.frames}
    result.append(Stage("report", {**everything, **tuning, **shown}, ["metrics.json", "report.html", "overview.png"]))
    return result


def describe_row(row: str) -> str:
    """A row of the table in words."""
    method, _, class_name = row.partition(":")
    return describe_method(method) + (f", on {class_name}s: a class never trained on" if class_name else "")


def file_name(row: str) -> str:
    """The name of a row in file names."""
    return row.replace(":", "-on-")


def score_method(
    row: str, data: Tasks, folder: Path, report: Callable[[ObjectScore], None], device: str = "cpu"
) -> None:
    """Evaluate one method on all held-out objects; its score goes to scores/, its pictures to pictures/.

    Args:
        row: one of `DemoSettings.rows`.
        data: with the held-out objects in its "test" split.
        folder: of the demonstration, with the checkpoints.
        report: called after each object.
        device: where to compute.
    """
    where = choose_device(device)
    tasks, names, file = TasksOnDevice(data, where), data.names("test"), file_name(row)
    adapter = _adapter(row.partition(":")[0], tasks, folder, where)

    def keep(score: ObjectScore, task: Task, pictures: Pictures) -> None:
        save_images(pictures.images, folder / "pictures" / file / score.name, task.query.names)
        report(score)

    score = evaluate(row, adapter, tasks, names, keep)
    write_json(folder / "scores" / f"{file}.json", score.as_json())


def _adapter(method: str, tasks: Tasks, folder: Path, device: torch.device) -> Adapter:
    objects = (tasks.task(name).support for name in tasks.names("test"))
    return make_method(method, {name: folder / name for name in MODELS}, device=device, objects=objects)


def measure_tuning(
    settings: DemoSettings, data: Tasks, folder: Path, report: Callable[[str, float], None], device: str = "cpu"
) -> None:
    """PSNR after several numbers of fine-tuning steps, of TUNED; written to tuning.json by method and steps.

    Args:
        settings: steps and objects.
        data: with the held-out objects in its "test" split.
        folder: of the demonstration, with the checkpoints.
        report: called with every row's name and its PSNR in dB.
        device: where to compute.
    """
    where = choose_device(device)
    tasks, names = TasksOnDevice(data, where), data.names("test")[: settings.tuned_objects]
    found: dict[str, dict[str, float]] = {method: {} for method in TUNED}
    for method in TUNED:
        for steps in settings.tuning:
            for name in at_steps(method, [steps]):
                quality = evaluate(name, _adapter(name, tasks, folder, where), tasks, names).mean("psnr")
                found[method][str(steps)] = quality
                report(name, quality)
    write_json(folder / "tuning.json", found)


def write_metrics(folder: Path, settings: DemoSettings) -> dict[str, dict[str, Any]]:
    """Put the scores of all rows into metrics.json.

    Args:
        folder: of the demonstration.
        settings: of the demonstration.

    Returns:
        What was written: psnr, ssim, seconds and the single objects by method.
    """
    metrics = {row: read_json(folder / "scores" / f"{file_name(row)}.json") for row in settings.rows}
    write_json(folder / "metrics.json", metrics)
    return metrics
