"""Ablations of the image-based field: each variant omits one part, is trained, and is evaluated by number of views.

    python -m benchmarks image_based --data data/cars --json FILE

Every variant is trained for the same number of steps on the same rays, with random numbers of random support views. It
is evaluated on held-out objects from 3, 5, 10 and 25 support views that are as far apart as possible. The network is
smaller than that of the preset "small", so that a training takes minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.configuration.presets import ALL_LAYERS, Preset, preset
from hyperplanes.data.dataset import Dataset, open_dataset, open_datasets
from hyperplanes.data.support import FarthestSupport
from hyperplanes.evaluation import evaluate
from hyperplanes.fields import TARGETS, ImageBasedConfig, ImageBasedNeRF
from hyperplanes.fields.image_based import ImageBasedField
from hyperplanes.geometry.chosen_views import Visibility
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.training import Trainer
from hyperplanes.views import Views

__all__ = ["HYPERNETWORKS", "VARIANTS", "configured", "main", "trained"]


class _WithoutDepth(ImageBasedNeRF):
    """A field for which every view onto which a point projects counts as seeing it, even if the point is occluded."""

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        planes = super().planes_of(views, occupancy)
        planes.depth_opacity[..., 0] = 1e3  # the depth of the first surface: behind all points
        return planes


class _WithoutCoverage(ImageBasedNeRF):
    """A field that does not read the masks; they only determine the visual hull in which samples are taken."""

    def planes_of(self, views: Views, occupancy: Occupancy) -> VisibilityPlanes:
        planes = super().planes_of(views, occupancy)
        planes.depth_opacity[..., 1] = 1.0
        return planes


class _Unsorted(VisibilityPlanes):
    """Planes that return the valid views of a point in the order of the object's views, not by penalty."""

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
    """A field whose colour comes from the network alone; colours of the views are not blended."""

    def _blend(self, value: Tensor, weights: Tensor, colours: Tensor) -> Tensor:
        return super()._blend(value, weights, torch.full_like(colours, 0.5))


class _WithoutBlending(ImageBasedNeRF):
    def bind(self, *given: Any) -> ImageBasedField:
        made = super().bind(*given)
        return _PlainField(made.target, made.parameters, made.planes, made.bounds)


class _RandomStart(ImageBasedNeRF):
    """A field whose density head is initialised like those of other fields, not to reproduce the visual hull."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        torch.nn.init.kaiming_uniform_(self.density.weight, nonlinearity="relu")
        torch.nn.init.constant_(self.density.bias, -2.0)


@dataclass(frozen=True)
class _Reader:
    """A variant of the hypernetwork.

    Attributes:
        images: it reads images instead of a volume.
        grid: the field has a feature grid, which the hypernetwork writes.
        completed: the loss that completes the volume is used in training.
    """

    images: bool = False
    grid: bool = True
    completed: bool = True


HYPERNETWORKS = {
    "hypernetwork": _Reader(),
    "without_completion": _Reader(completed=False),
    "reads_images": _Reader(images=True, grid=False, completed=False),
}
"""Variants with a hypernetwork: the whole, and with changes."""

VARIANTS: dict[str, type[ImageBasedNeRF]] = {
    "whole": ImageBasedNeRF,
    "without_depth": _WithoutDepth,
    "without_coverage": _WithoutCoverage,
    "without_order": _WithoutOrder,
    "without_blending": _WithoutBlending,
    "random_start": _RandomStart,
}


def main(arguments: list[str]) -> int:
    """Train the variants, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks image_based", description=__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--variant", nargs="+", choices=(*VARIANTS, *HYPERNETWORKS, "white"), default=list(VARIANTS))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--counts", type=positive, nargs="+", default=[3, 5, 10, 25], help="numbers of support views")
    parser.add_argument("--objects", type=positive, default=4, help="held-out objects per data set to evaluate on")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--quick", action="store_true", help="2 steps, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.steps, chosen.counts, chosen.objects = 2, [3], 1
    data, rows = open_datasets(chosen.data), []
    sets = {path.resolve().name: open_dataset(path) for path in chosen.data}
    for name in chosen.variant:
        for seed in chosen.seeds:
            begun = time.perf_counter()
            with configured(name, chosen.steps, seed) as made:
                model = trained(made, data)
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
    """Mean PSNR of three query views of each of `objects` held-out objects, from `count` support views."""
    names = sorted(data.names("test"))[:objects]
    return evaluate("one_step", model, FarthestSupport(data, count, 3), names).mean("psnr")


@contextmanager
def configured(name: str, steps: int, seed: int) -> Generator[Preset]:
    """A variant of the preset "small", with a network of 3 x 96, a hull of 64 voxels per axis, and 128 rays per object.

    Objects are not rotated, and pictures are rendered from the field alone, without `hull_blend`. The field of the
    variant has its name in `fields.TARGETS` while the context is active.

    Args:
        name: in VARIANTS or HYPERNETWORKS, or "white", which trains without random backgrounds. Only those in
            HYPERNETWORKS have a hypernetwork.
        steps: training steps.
        seed: of the training.

    Yields:
        The preset.
    """
    with patch.dict(TARGETS, {name: VARIANTS.get(name, ImageBasedNeRF)}):
        yield _preset(name, steps, seed)


def _preset(name: str, steps: int, seed: int) -> Preset:
    """The preset of a variant whose field is in TARGETS."""
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
    model = replace(model, stacked=False, symmetric=False)  # evaluate the field alone
    return replace(made, model=model, training=training)


def trained(made: Preset, data: Any) -> HyperPlanes:
    """Train a model of this preset; it is returned in evaluation mode."""
    model = HyperPlanes(made.model, made.training.seed)
    trainer = Trainer(model, data, made.training)
    while trainer.step < made.training.steps:
        trainer.take_step()
    return model.eval()
