"""The demonstration: what it is made of, and each of its stages as a function."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hyperplanes.adaptation.base import Pictures
from hyperplanes.checkpoints import read_json
from hyperplanes.evaluation import ObjectScore, evaluate, make_method
from hyperplanes.export import save_images
from hyperplanes.files import write_json
from hyperplanes.models import OnDevice, choose_device, on_device
from hyperplanes.presets import Preset
from hyperplanes.recipes import recipe
from hyperplanes.rendering.renderer import Marched
from hyperplanes.stages import Stage
from hyperplanes.training import Tasks
from hyperplanes.views import Task

__all__ = ["METHODS", "MODELS", "DemoSettings", "recipes", "score_method", "stages", "write_metrics"]

METHODS = ("nearest_view", "point_multiplane", "hyperplanes", "hyperplanes_10")
"""The rows of the demonstration's table."""

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
        tiny: networks so small that nothing is learnt: to see that everything runs.
    """

    class_name: str = "car"
    objects: int = 70
    held_out: int = 10
    resolution: int = 64
    views: int = 50
    preset: str = "quick"
    steps: int | None = None
    seed: int = 0
    exhibits: int = 6
    frames: int = 36
    tiny: bool = False

    @classmethod
    def quick_check(cls, seed: int = 0) -> DemoSettings:
        """A demonstration of seconds that shows nothing but that it runs."""
        return cls(objects=3, held_out=1, resolution=24, views=12, steps=20, seed=seed, exhibits=1, frames=6, tiny=True)


def recipes(settings: DemoSettings) -> dict[str, Preset]:
    """Model and training of each of MODELS."""
    chosen = {name: recipe(settings.preset, name, steps=settings.steps, seed=settings.seed) for name in MODELS}
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
            sampling=Marched(steps=16),
            hull_side=16,
        ),
        training=replace(chosen.training, rays=32, warmup=0, checkpoint_every=10),
    )


def stages(settings: DemoSettings) -> list[Stage]:
    """The stages in their order, each with all that decides its result."""
    described = json.loads(json.dumps(asdict(settings)))
    data = {key: described[key] for key in ("class_name", "objects", "held_out", "resolution", "views", "seed")}
    result = [Stage("data", data, ["data"])]
    models: dict[str, Any] = {}
    for name, chosen in recipes(settings).items():
        models[name] = {"model": chosen.model.as_json(), "training": asdict(chosen.training)}
        own = json.loads(json.dumps({"data": data, **models[name]}))
        result.append(Stage(name, own, [name]))
    everything = json.loads(json.dumps({"data": data, "models": models}))
    for name in METHODS:
        result.append(Stage(f"evaluate {name}", everything, [f"scores/{name}.json", f"pictures/{name}"]))
    shown = {"exhibits": settings.exhibits, "frames": settings.frames}
    result.append(Stage("report", {**everything, **shown}, ["metrics.json", "report.html", "overview.png"]))
    return result


def score_method(
    method: str, data: Tasks, folder: Path, report: Callable[[ObjectScore], None], device: str = "cpu"
) -> None:
    """Evaluate one method on all held-out objects; its score goes to scores/, its pictures to pictures/.

    Args:
        method: one of METHODS.
        data: with the held-out objects in its "test" split.
        folder: of the demonstration, with the checkpoints.
        report: called after each object.
        device: where to compute.
    """
    where = choose_device(device)
    adapter = on_device(make_method(method, {name: folder / name for name in MODELS}), where)

    def keep(score: ObjectScore, task: Task, pictures: Pictures) -> None:
        save_images(pictures.images, folder / "pictures" / method / score.name, task.query.names)
        report(score)

    score = evaluate(method, adapter, OnDevice(data, where), data.names("test"), keep)
    write_json(folder / "scores" / f"{method}.json", score.as_json())


def write_metrics(folder: Path) -> dict[str, dict[str, Any]]:
    """Put the scores of all methods into metrics.json.

    Returns:
        What was written: psnr, ssim, seconds and the single objects by method.
    """
    metrics = {method: read_json(folder / "scores" / f"{method}.json") for method in METHODS}
    write_json(folder / "metrics.json", metrics)
    return metrics
