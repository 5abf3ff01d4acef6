"""Compare rendering by the packaged model `small` with plain PyTorch that evaluates every sample.

    python -m benchmarks small --json FILE
    python -m benchmarks small --scene SCENE --views 50

The object is a held-out procedural car, or a posed scene. Measured are the time to adapt, the time of a view at several
sizes, and PSNR. The reference is the same field in PyTorch, which looks up and concatenates the inputs of the network
and multiplies its layers. It computes the colour of every sample in every voxel of the visual hull that is not empty
and in the voxels around them, until rays are as opaque as in training. Both run alternately in one process. The views
are also rendered with only the layers multiplied by PyTorch, and in single precision.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from kornia.geometry.camera import PinholeCamera

from benchmarks.parts.objects import held_out
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import interleaved, ratio, timed, without
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.base import AdaptedField, Pictures
from hyperplanes.data import read_task
from hyperplanes.fields.layers import PackedLayers
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.rendering.refinement import RefinedOccupancy
from hyperplanes.rendering.refinement import refine as refine_voxels
from hyperplanes.rendering.sampling.marching import RayMarching
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task

__all__ = ["main"]


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks small", description=__doc__)
    parser.add_argument("--sizes", type=positive, nargs="+", default=[128, 400], help="pixels per side of the car")
    parser.add_argument("--scene", type=Path, help="a posed scene instead of the car")
    parser.add_argument("--views", type=positive, default=25, help="number of support views (default: %(default)s)")
    parser.add_argument("--repeats", type=positive, default=5, help="number of query views (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a car of 64 pixels, two views")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    sizes, repeats = ([64], 2) if chosen.quick else (chosen.sizes, chosen.repeats)
    model = HyperPlanes.from_pretrained("small")
    rows = []
    if chosen.scene is not None:
        rows.append(measure(model, _shown(read_task(chosen.scene), chosen.views), repeats))
    else:
        for size in sizes:
            task = _shown(held_out(1, size, 2 * chosen.views)[0], chosen.views)
            rows.append(measure(model, task, repeats))
    return finish("small", rows, chosen.json)


def measure(model: HyperPlanes, task: Task, repeats: int) -> Row:
    """Measure one object; for each view, the default and the reference in turn."""
    model.adapt(task.support)  # compiles kernels and fills caches before the measurement
    adapt, adapted = timed(lambda: model.adapt(task.support))
    adapted = adapted.without_residuals()
    with _plainly():
        adapted(*2 * (adapted.occupancy.centres()[:1],))  # compiles kernels before the measurement
        voxels = refine_voxels(adapted.occupancy, adapted.density)
    assert isinstance(adapted.sampling, RayMarching)
    every = RayMarching(adapted.sampling.steps * 5 // 3, adapted.sampling.stop)
    views = [(7 * number + 3) % len(task.query) for number in range(repeats)]
    seconds, reference, found, expected = [], [], [], []
    for view in views:
        one = camera.select(task.query.cameras, [view])
        time, pictures = timed(lambda one=one: adapted.render(one))
        with _plainly():
            plain_time, plain = timed(lambda one=one: _unsplit(adapted, voxels).render(one, every))
        seconds.append(time)
        reference.append(plain_time)
        found += _quality(pictures, task, [view])
        expected += _quality(plain, task, [view])
    several = camera.select(task.query.cameras, views)
    ways = {
        "ours": lambda: adapted.render(several),
        "single precision": lambda: adapted.render(several, mixed_precision=False),
        "PyTorch's layers": lambda: _multiplied(adapted, several),
    }
    layers = interleaved(ways, repeats)
    rounded, single = (statistics.fmean(_quality(ways[way](), task, views)) for way in ("ours", "single precision"))
    height, width = task.query.size
    return {
        "name": f"small, {task.name}, {width}x{height}, {len(task.support)} views",
        "threads": torch.get_num_threads(),
        "seconds": statistics.median(seconds),
        "reference_seconds": statistics.median(reference),
        "speedup_of_layers": ratio(layers["PyTorch's layers"].wall, layers["ours"].wall)["speedup"],
        "speedup_of_mixed_precision": ratio(layers["single precision"].wall, layers["ours"].wall)["speedup"],
        "psnr_loss_of_mixed_precision": single - rounded,
        "speedup": statistics.median(plain / ours for plain, ours in zip(reference, seconds, strict=True)),
        "psnr": statistics.fmean(found),
        "psnr_loss": statistics.fmean(expected) - statistics.fmean(found),
        "adapt_seconds": adapt,
    }


def _multiplied(adapted: AdaptedField, cameras: PinholeCamera) -> Pictures:
    """Render the views with layers that PyTorch multiplies."""
    with without(PackedLayers, "takes"):
        return adapted.render(cameras)


def _shown(task: Task, count: int) -> Task:
    """The task with `count` of its support views, evenly spaced in their order."""
    return replace(task, support=task.support[:: max(1, len(task.support) // count)][:count])


def _quality(pictures: Pictures, task: Task, views: list[int]) -> list[float]:
    return psnr(pictures.images, task.query.images[views]).tolist()


def _unsplit(adapted: AdaptedField, voxels: RefinedOccupancy) -> AdaptedField:
    """The same field as a plain function, so that the colours of all samples are computed in all these voxels."""
    field: Callable = adapted.field
    return replace(adapted, field=lambda points, directions: field(points, directions), refined=voxels)


@contextmanager
def _plainly() -> Generator[None]:
    """While active, no kernel computes the inputs of the network, and none multiplies its layers."""
    with without(VisibilityPlanes, "can_describe"), without(PackedLayers, "takes"):
        yield
