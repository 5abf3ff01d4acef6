"""What the parts of the field of any number of views are worth: each left out, trained again and judged by views shown.

    python -m benchmarks image_based --data data/cars --json FILE

Every variant is trained for the same steps on the same rays of random numbers of random views, and judged on held-out
objects by 3, 5, 10 and 25 views that stand as far apart as they can. The network is smaller than that of the preset
"small", so that a training takes minutes.
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

from benchmarks.options import positive
from benchmarks.reporting import Row, finish
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.configuration.presets import ALL_LAYERS, Preset, preset
from hyperplanes.data.dataset import Dataset, open_dataset, open_datasets
from hyperplanes.data.support import Shown
from hyperplanes.evaluation import evaluate
from hyperplanes.fields import TARGETS, ImageBasedConfig, ImageBasedNeRF
from hyperplanes.fields.image_based import ImageBasedField
from hyperplanes.geometry.chosen_views import Visibility
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.training import Trainer
from hyperplanes.views import Views

__all__ = ["HYPERNETWORKS", "VARIANTS", "configured", "main", "trained"]


class _WithoutDepth(ImageBasedNeRF):
    """Every view that shows a point counts as seeing it."""

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        planes = super().planes_of(views, occupancy)
        planes.depth_opacity[..., 0] = 1e3  # the first surface lies behind everything
        return planes


class _WithoutCoverage(ImageBasedNeRF):
    """Nothing is known of the masks but the hull that is sampled."""

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        planes = super().planes_of(views, occupancy)
        planes.depth_opacity[..., 1] = 1.0
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


class _WithoutOrder(ImageBasedNeRF):
    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        return _Unsorted(views.images, views.cameras, views.masks, occupancy)


@dataclass(frozen=True)
class _PlainField(ImageBasedField):
    """The colour is the network's alone."""

    def _blend(self, value: Tensor, weights: Tensor, colours: Tensor) -> Tensor:
        return super()._blend(value, weights, torch.full_like(colours, 0.5))


class _WithoutBlending(ImageBasedNeRF):
    def bind(self, *given: Any) -> ImageBasedField:
        made = super().bind(*given)
        return _PlainField(made.target, made.parameters, made.planes, made.bounds)


class _RandomStart(ImageBasedNeRF):
    """The density head begins as that of the other fields, not as the visual hull."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        torch.nn.init.kaiming_uniform_(self.density.weight, nonlinearity="relu")
        torch.nn.init.constant_(self.density.bias, -2.0)


@dataclass(frozen=True)
class _Reader:
    """What of the hypernetwork is changed or left out."""

    images: bool = False
    grid: bool = True
    completed: bool = True


HYPERNETWORKS = {
    "hypernetwork": _Reader(),
    "without_completion": _Reader(completed=False),
    "reads_images": _Reader(images=True, grid=False, completed=False),
}
"""What the hypernetwork of the field is worth, and what its parts are."""

VARIANTS: dict[str, type[ImageBasedNeRF]] = {
    "whole": ImageBasedNeRF,
    "without_depth": _WithoutDepth,
    "without_coverage": _WithoutCoverage,
    "without_order": _WithoutOrder,
    "without_blending": _WithoutBlending,
    "random_start": _RandomStart,
}


def main(arguments: list[str]) -> int:
    """Train, print, and write the rows where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks image_based", description=__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--variant", nargs="+", choices=(*VARIANTS, *HYPERNETWORKS, "white"), default=list(VARIANTS))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--counts", type=positive, nargs="+", default=[3, 5, 10, 25], help="numbers of support views")
    parser.add_argument("--objects", type=positive, default=4, help="held-out ones of each data set to judge by")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--quick", action="store_true", help="2 steps: to see that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the rows go")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.steps, chosen.counts, chosen.objects = 2, [3], 1
    data, rows = open_datasets(chosen.data), []
    sets = {path.resolve().name: open_dataset(path) for path in chosen.data}
    for name in chosen.variant:
        for seed in chosen.seeds:
            begun = time.perf_counter()
            model = trained(configured(name, chosen.steps, seed), data)
            row: Row = {"name": name, "seed": seed, "steps": chosen.steps, "seconds": time.perf_counter() - begun}
            for count in chosen.counts:
                found = [_judged(model, each, count, chosen.objects) for each in sets.values()]
                row[f"psnr_{count}"] = sum(found) / len(found)
                if len(sets) > 1:
                    row |= {f"psnr_{count}_{each}": value for each, value in zip(sets, found, strict=True)}
            rows.append(row)
            print(row, flush=True)
    return finish("image_based", rows, chosen.json)


def _judged(model: HyperPlanes, data: Dataset, count: int, objects: int) -> float:
    """Mean PSNR of three query views of each of some held-out objects with so many views shown."""
    return evaluate("one_step", model, Shown(data, count, 3), sorted(data.names("test"))[:objects]).mean("psnr")


def configured(name: str, steps: int, seed: int) -> Preset:
    """The preset "small" with a network of 3 x 96, a hull of 64 voxels an axis, 128 rays an object, and one change.

    Objects are not rotated, and pictures are the field's alone.

    Args:
        name: of VARIANTS, "white" or HYPERNETWORKS; only the last have a hypernetwork.
    """
    TARGETS[name] = VARIANTS.get(name, ImageBasedNeRF)
    made, wanted = preset("small"), HYPERNETWORKS.get(name)
    training = replace(
        made.training,
        steps=steps,
        seed=seed,
        rays=128,
        warmup=min(60, steps // 4),
        held_out=0,
        rotations=0.0,
        random_background=name != "white",
        volume_loss=made.training.volume_loss if wanted and wanted.completed else 0.0,
    )
    network = made.model.network
    assert isinstance(network, ImageBasedConfig)
    network = replace(network, depth=3, width=96, grid=network.grid if wanted and wanted.grid else 0)
    volume = made.model.hypernetwork
    reader = None if wanted is None else volume
    if wanted is not None and wanted.images:
        reader = replace(ALL_LAYERS, join="mean", views=6, resolution=64)
    model = replace(made.model, target=name, network=network, hypernetwork=reader, hull_resolution=64)
    model = replace(model, stacked=False, symmetric=False)  # what the field alone shows
    return replace(made, model=model, training=training)


def trained(made: Preset, data: Any) -> HyperPlanes:
    """A model after its training."""
    model = HyperPlanes(made.model, made.training.seed)
    trainer = Trainer(model, data, made.training)
    while trainer.step < made.training.steps:
        trainer.take_step()
    return model.eval()
