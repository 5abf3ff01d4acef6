"""What the parts of the field of any number of views are worth: each left out, trained again and judged by views shown.

    python -m benchmarks any_order --data data/cars --json FILE

Every variant is trained for the same steps on the same rays of random numbers of random views, and judged on held-out
objects by 3, 5, 10 and 25 views that stand as far apart as they can.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.reporting import Row, finish
from benchmarks.views import Shown
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.data.dataset import open_datasets
from hyperplanes.evaluation import evaluate
from hyperplanes.fields import TARGETS, AnyOrderNeRF
from hyperplanes.fields.any_order import AnyOrderField
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.visibility import Visibility, VisibilityPlanes
from hyperplanes.presets import Preset, preset
from hyperplanes.training import Trainer
from hyperplanes.views import Views

__all__ = ["VARIANTS", "configured", "main", "trained"]


class _WithoutDepth(AnyOrderNeRF):
    """Every view that shows a point counts as seeing it."""

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        planes = super().planes_of(views, occupancy)
        planes.guides[..., 0] = 1e3  # the first surface lies behind everything
        return planes


class _WithoutCoverage(AnyOrderNeRF):
    """Nothing is known of the masks but the hull that is sampled."""

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        planes = super().planes_of(views, occupancy)
        planes.guides[..., 1] = 1.0
        return planes


class _Unsorted(VisibilityPlanes):
    """The views of a point in the order of the object's, as far as they show it."""

    def choose(self, points: Tensor, directions: Tensor | None = None, *, best: int, nearest: int = 0) -> Visibility:
        found = super().choose(points, directions, best=len(self), nearest=nearest)
        order = torch.where(found.best.valid, found.best.views, len(self)).argsort(1)[:, :best]

        def taken(value: Tensor) -> Tensor:
            return value.gather(1, order if value.ndim == 2 else order[..., None].expand(-1, -1, 3))

        views = type(found.best)(*(taken(getattr(found.best, each.name)) for each in dataclasses.fields(found.best)))
        return replace(found, best=views)


class _WithoutOrder(AnyOrderNeRF):
    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        return _Unsorted(views.images, views.cameras, views.masks, occupancy)


@dataclass(frozen=True)
class _PlainField(AnyOrderField):
    """The colour is the network's alone."""

    def blended(self, weights: Tensor, colours: Tensor) -> Tensor:
        return torch.full_like(colours[:, 0], 0.5)


class _WithoutBlending(AnyOrderNeRF):
    def bind(self, *given: Any) -> AnyOrderField:
        field = super().bind(*given)
        return _PlainField(field.target, field.parameters, field.planes, field.bounds)


class _RandomStart(AnyOrderNeRF):
    """The density head begins as that of the other fields, not as the visual hull."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        torch.nn.init.kaiming_uniform_(self.density.weight, nonlinearity="relu")
        torch.nn.init.constant_(self.density.bias, -2.0)


VARIANTS: dict[str, type[AnyOrderNeRF]] = {
    "whole": AnyOrderNeRF,
    "without_depth": _WithoutDepth,
    "without_coverage": _WithoutCoverage,
    "without_order": _WithoutOrder,
    "without_blending": _WithoutBlending,
    "random_start": _RandomStart,
}


def main(arguments: list[str]) -> int:
    """Train, print, and write the rows where asked.

    Args:
        arguments: see --help.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks any_order", description=__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--variant", nargs="+", choices=(*VARIANTS, "hypernetwork", "white"), default=list(VARIANTS))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--counts", type=int, nargs="+", default=[3, 5, 10, 25], help="numbers of support views")
    parser.add_argument("--objects", type=int, default=4, help="held-out ones to judge by")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--quick", action="store_true", help="2 steps: to see that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the rows go")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.steps, chosen.counts, chosen.objects = 2, [3], 1
    data, rows = open_datasets(chosen.data), []
    names = sorted(data.names("test"))[: chosen.objects]
    for name in chosen.variant:
        for seed in chosen.seeds:
            begun = time.perf_counter()
            model = trained(configured(name, chosen.steps, seed), data)
            row: Row = {"name": name, "seed": seed, "steps": chosen.steps, "seconds": time.perf_counter() - begun}
            for count in chosen.counts:
                score = evaluate(name, model, Shown(data, count, 3), names)
                row[f"psnr_{count}"] = score.mean("psnr")
            rows.append(row)
            print(row, flush=True)
    return finish("any_order", rows, chosen.json)


def configured(name: str, steps: int, seed: int) -> Preset:
    """The preset "small" without its hypernetwork, and one thing else.

    Args:
        name: of VARIANTS; "hypernetwork" leaves it in, "white" trains over white backgrounds.
        steps: of training.
        seed: of weights and training.
    """
    TARGETS[name] = VARIANTS.get(name, AnyOrderNeRF)
    made = preset("small")
    hypernetwork = made.model.hypernetwork if name == "hypernetwork" else None
    training = replace(
        made.training, steps=steps, seed=seed, warmup=min(60, steps // 4), held_out=0, random_background=name != "white"
    )
    return replace(made, model=replace(made.model, target=name, hypernetwork=hypernetwork), training=training)


def trained(made: Preset, data: Any) -> HyperPlanes:
    """A model after its training.

    Args:
        made: model and training.
        data: the objects.
    """
    model = HyperPlanes(made.model, made.training.seed)
    trainer = Trainer(model, data, made.training)
    while trainer.step < made.training.steps:
        trainer.take_step()
    return model.eval()
