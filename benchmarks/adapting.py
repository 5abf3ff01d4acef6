"""Adapt to one object from its files; measure seconds, and PSNR on query views.

    python -m benchmarks adapting --views data/chair --json FILE

Three methods are compared: one forward pass of the packaged model; voxels that are baked from its field and fitted to
the support views; and, as the reference, fine-tuning of the model. The time includes reading the files, but not
rendering the query views.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.parts.objects import held_out
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.base import Renderable
from hyperplanes.data import read_task
from hyperplanes.export.animation import fitted_voxels
from hyperplanes.export.baking import BakedScene, default_side
from hyperplanes.export.voxel_fitting import VOXEL_STEPS
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task, Views

__all__ = ["main"]

TUNING = "fine-tuned"


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks adapting", description=__doc__)
    parser.add_argument("--views", type=Path, help="posed images (default: a procedural car)")
    parser.add_argument("--checkpoint", default="small", help="the model (default: %(default)s)")
    parser.add_argument(
        "--fit", type=int, nargs="+", default=[VOXEL_STEPS, 2 * VOXEL_STEPS], help="steps for fitting voxels"
    )
    parser.add_argument("--side", type=positive, help="voxels per axis (default: as for exported pages)")
    parser.add_argument("--steps", type=int, default=100, help="steps of fine-tuning, the reference; 0 omits it")
    parser.add_argument("--query", type=positive, default=10, help="number of query views (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a small car and few steps, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.fit, chosen.side, chosen.steps, chosen.query = [2], 32, 1, 1
    read = partial(read_task, chosen.views) if chosen.views else partial(_car, 32 if chosen.quick else 200)
    model = HyperPlanes.from_pretrained(chosen.checkpoint)

    ways: dict[str, Callable[[Views], Renderable]] = {"one forward pass": model.adapt}
    for fit in chosen.fit:
        ways[f"voxels, {fit} steps"] = partial(_voxels, model, chosen.side, fit)
    if chosen.steps:
        ways[f"{TUNING}, {chosen.steps} steps"] = lambda views: model.fine_tune(views, chosen.steps)
    task = read()
    every = max(1, len(task.query) // chosen.query)
    query = task.query[torch.arange(0, len(task.query), every)[: chosen.query]]
    _warm_up(model, replace(task, query=query))
    rows = [_measured(name, way, read, query) for name, way in ways.items()]
    if chosen.steps:
        for row in rows:
            row["speedup"] = float(rows[-1]["seconds"]) / float(row["seconds"])
            row["psnr_loss"] = float(rows[-1]["psnr"]) - float(row["psnr"])
    return finish("adapting", rows, chosen.json)


def _measured(name: str, way: Callable[[Views], Renderable], read: Callable[[], Task], query: Views) -> Row:
    begun, computed = time.perf_counter(), time.process_time()
    task = read()
    reading = time.perf_counter() - begun
    made = way(task.support)
    seconds, processor = time.perf_counter() - begun, time.process_time() - computed
    pictures = made.render(query.cameras).images.clamp(0, 1)
    quality = float(psnr(pictures, query.images).mean())
    row: Row = {"name": f"{task.name}, {len(task.support)} views, {name}", "threads": torch.get_num_threads()}
    row |= {"seconds": seconds, "processor_seconds": processor, "reading_seconds": reading, "psnr": quality}
    print(row, flush=True)
    return row


def _voxels(model: HyperPlanes, side: int | None, fit: int, views: Views) -> BakedScene:
    return BakedScene(fitted_voxels(model.adapt(views), views, side or default_side(views.size), steps=fit))


def _warm_up(model: HyperPlanes, task: Task) -> None:
    """Use each method once on small copies of the views, so that compilation and caches are not measured."""
    views = task.support.resized(32)
    _voxels(model, 32, 1, views).render(task.query[:1].cameras)
    model.fine_tune(views, 1).render(task.query[:1].resized(32).cameras)


def _car(size: int) -> Task:
    return held_out(1, size, 50)[0]
