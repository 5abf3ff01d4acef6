"""Measure rendering, adapting and training on a GPU, and compare several implementations of rendering there.

    python -m benchmarks gpu --json FILE
    python -m benchmarks gpu --data data/cars --json FILE

`small` and the paper's network render views of a held-out car from 25 support views. The default is compared with
lookups by PyTorch instead of the fused kernel; with single precision without TF32; with layers in bfloat16; and with
the field as one function that computes the colour of every sample: directly, replayed as a CUDA graph and, with
--compile, compiled by `torch.compile`. All run alternately in one process; times are medians. The paper's protocol
evaluates two networks, the coarse one at 64 and the fine one at 192 samples per ray.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Generator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import pad

from benchmarks.parts.objects import held_out
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import add_device_option, interleaved, peak_bytes, timed
from benchmarks.training import Objects
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.correction.stacking import StackedField
from hyperplanes.configuration.presets import preset
from hyperplanes.data import open_dataset
from hyperplanes.data.support import FarthestSupport
from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.fields.base import Field
from hyperplanes.geometry import cameras as camera
from hyperplanes.rendering import renderer
from hyperplanes.rendering.renderer import FieldFunction, Hierarchical
from hyperplanes.training import Trainer
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task, Tasks

__all__ = ["main"]

PAPER = Path(__file__).parent / "weights" / "paper-network"
PAPER_SAMPLES = Hierarchical(64, 128)
SHOWN, COMPARED = 25, 4
SIZES = (128, 200, 400)
SIZE_OF_WAYS = 200  # pixels per side for the comparison of implementations
SPAN = 1 << 14  # graphs and compiled functions are made for multiples of this number of points


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks gpu", description=__doc__)
    parser.add_argument("--data", type=Path, help="a data set (default: a procedural car)")
    add_device_option(parser, "cuda")
    parser.add_argument("--steps", type=int, default=100, help="steps of fine-tuning (default: %(default)s)")
    parser.add_argument("--repeats", type=positive, default=7, help="repetitions per view (default: %(default)s)")
    parser.add_argument("--compile", action="store_true", help="also compile the paper's network, in 1 to 2 minutes")
    parser.add_argument("--quick", action="store_true", help="few and small views, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    device = torch.device(chosen.device)
    sizes, repeats, steps = ((48,), 1, 1) if chosen.quick else (SIZES, chosen.repeats, chosen.steps)
    data: Tasks = Objects(held_out(4, max(sizes), 50)) if chosen.data is None else open_dataset(chosen.data)
    rows = adapting(data, device, steps) + training(data, device, repeats)
    rows += views(str(PAPER), data, device, sizes, repeats) + views("small", data, device, sizes, repeats)
    if chosen.compile:
        rows += compiled(data, device, _size_of_ways(sizes), repeats)
    return finish("gpu", rows, chosen.json, device.type)


def views(checkpoint: str, data: Tasks, device: torch.device, sizes: tuple[int, ...], repeats: int) -> list[Row]:
    """Rows for views of each size by default, and for views of one size by all implementations."""
    model, name = HyperPlanes.from_pretrained(checkpoint).to(device), Path(checkpoint).name
    rows: list[Row] = []
    for size in sizes:
        task = _task(data, size, device)
        adapted = model.adapt(task.support).without_residuals()
        drawn = {"default": _drawing(adapted, antialias=True), "one ray a pixel": _drawing(adapted)}
        if not isinstance(adapted, StackedField):  # the second field of a StackedField has no coarse network
            drawn["paper's protocol"] = _drawing(adapted, sampling=PAPER_SAMPLES)
        if size == _size_of_ways(sizes):
            drawn |= _ways(adapted, device)
        rows += _compare(f"{name}, {size}x{size}", task, drawn, repeats)
    return rows


def _size_of_ways(sizes: tuple[int, ...]) -> int:
    return SIZE_OF_WAYS if SIZE_OF_WAYS in sizes else sizes[0]


def _task(data: Tasks, size: int, device: torch.device) -> Task:
    """The first held-out object, with 25 support views and some query views of `size` pixels per side."""
    names = sorted(data.names("test") or data.names("train"))
    task = _Resized(FarthestSupport(data, SHOWN, COMPARED), size).task(names[0])
    return Task(task.support.to(device), task.query.to(device), task.name)


@dataclass(frozen=True)
class _Resized(TaskWrapper):
    """Tasks whose images have `size` pixels per side."""

    size: int

    def change(self, task: Task) -> Task:
        return Task(task.support.resized(self.size), task.query.resized(self.size), task.name)


@dataclass(frozen=True)
class Drawing:
    """An implementation of rendering.

    Attributes:
        adapted: the field.
        options: options of its `render`.
        around: a context in which it renders.
    """

    adapted: AdaptedField
    options: dict[str, Any] = field(default_factory=dict)
    around: Callable[[], Any] = nullcontext

    def __call__(self, cameras: PinholeCamera) -> Tensor:
        with self.around():
            return self.adapted.render(cameras, **self.options).images


def _drawing(
    adapted: AdaptedField, around: Callable[[], Any] = nullcontext, antialias: bool = False, **options: Any
) -> Drawing:
    return Drawing(adapted, {"antialias": antialias, **options}, around)


def _ways(adapted: AdaptedField, device: torch.device) -> dict[str, Drawing]:
    """Variants of rendering with one ray per pixel: each replaces one part, or how the field is evaluated."""
    found = {
        "lookups by PyTorch": _drawing(adapted, _lookups_by_pytorch),
        "no TF32": _drawing(adapted, _without_tf32),
        "layers in bfloat16": _drawing(adapted, partial(_layers_in_bfloat16, device.type)),
        "field as a function": _drawing(_with_functions(adapted, lambda function: function)),
    }
    if device.type == "cuda":
        found["CUDA graph of that"] = _drawing(_with_functions(adapted, Graphed))
    return found


def compiled(data: Tasks, device: torch.device, size: int, repeats: int) -> list[Row]:
    """Rows for a view by the paper's network, compiled for numbers of points that are rounded up."""

    def change(function: FieldFunction) -> FieldFunction:
        fast = torch.compile(function, dynamic=False)

        def padded(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
            count = len(points)
            colour, density = fast(*(pad(each, (0, 0, 0, _rounded_up(count) - count)) for each in (points, directions)))
            return colour[:count], density[:count]

        return padded

    task = _task(data, size, device)
    adapted = HyperPlanes.from_pretrained(PAPER).to(device).adapt(task.support)
    drawn = {
        "field as a function": _drawing(_with_functions(adapted, lambda function: function)),
        "torch.compile of that": _drawing(_with_functions(adapted, change)),
    }
    return _compare(f"{PAPER.name}, {size}x{size}", task, drawn, repeats)


def _with_functions(adapted: AdaptedField, change: Callable[[FieldFunction], FieldFunction]) -> AdaptedField:
    """A field whose network is replaced by `change` of a function of points and directions.

    The second field of a `StackedField` is changed, too.
    """

    def function(one: AdaptedField) -> FieldFunction:
        return change(lambda points, directions: one.field(points, directions))

    _ = adapted.refined_occupancy
    if isinstance(adapted, StackedField):
        other = replace(adapted.other, field=function(adapted.other))
        return replace(adapted, field=function(adapted), other=other, refined=adapted.refined_occupancy)
    return replace(adapted, field=function(adapted), refined=adapted.refined_occupancy)


@contextmanager
def _layers_in_bfloat16(device: str) -> Generator[None]:
    """While active, the layers before the heads are computed in bfloat16."""
    trunk = Field.trunk

    def rounded(field: Field, inputs: Tensor) -> Tensor:
        with torch.autocast(device, torch.bfloat16):
            return trunk(field, inputs).float()

    with patch.object(Field, "trunk", rounded):
        yield


def _rounded_up(count: int) -> int:
    """A number of points, rounded up to a multiple of SPAN."""
    return -(-max(1, count) // SPAN) * SPAN


class Graphed:
    """A field that is recorded as a CUDA graph once for each number of points, rounded up, and then replayed.

    Args:
        function: a function of points and directions, without gradients, that does not synchronise with the GPU.
    """

    def __init__(self, function: FieldFunction) -> None:
        self.function = function
        self.graphs: dict[int, tuple[torch.cuda.CUDAGraph, list[Tensor]]] = {}

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Colours and densities."""
        count = len(points)
        padded = _rounded_up(count)
        if padded not in self.graphs:
            self.graphs[padded] = self._record(padded, points.device)
        graph, tensors = self.graphs[padded]
        tensors[0][:count], tensors[1][:count] = points, directions
        graph.replay()
        return tensors[2][:count].clone(), tensors[3][:count].clone()

    def _record(self, count: int, device: torch.device) -> tuple[torch.cuda.CUDAGraph, list[Tensor]]:
        inputs = [torch.zeros(count, 3, device=device) for _ in range(2)]
        inputs[1][:, 0] = 1
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(2):
                self.function(*inputs)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            colour, density = self.function(*inputs)
        return graph, [*inputs, colour, density]


@contextmanager
def _lookups_by_pytorch() -> Generator[None]:
    with patch("hyperplanes.geometry.lookup.choose", lambda *_: "torch"):
        yield


@contextmanager
def _without_tf32() -> Generator[None]:
    with patch.object(renderer, "allow_tf32", lambda _: nullcontext()):
        yield


def _compare(name: str, task: Task, drawn: dict[str, Drawing], repeats: int) -> list[Row]:
    """A row for each implementation, measured alternately; for one that fails, the row has the error instead."""
    one, several, working = camera.select(task.query.cameras, [1]), task.query.cameras, {}
    rows: list[Row] = []
    for way, draw in drawn.items():
        try:
            first, _ = timed(lambda draw=draw: draw(one))
            images = draw(several)
            draw(one)
        except Exception as error:  # compilers raise many types
            rows.append({"name": f"{name}, {way}", "error": f"{type(error).__name__}: {str(error)[:300]}"})
            continue
        working[way] = draw
        peak = peak_bytes(lambda draw=draw: draw(one), one.intrinsics.device.type) / 2**30
        quality = float(psnr(images.clamp(0, 1), task.query.images).mean())
        rows.append({"name": f"{name}, {way}", "first_seconds": first, "psnr": quality, "peak_gib": peak})
    times = interleaved({way: (lambda draw=draw: draw(one)) for way, draw in working.items()}, repeats)
    measured = iter(times.values())
    for row in rows:
        if "error" not in row:
            row["milliseconds"] = 1e3 * statistics.median(next(measured).wall)
    for row in rows:
        print(row, flush=True)
    return rows


def adapting(data: Tasks, device: torch.device, steps: int) -> list[Row]:
    """Rows for adapting `small` to an object, with and without the search for symmetry, and for fine-tuning it."""
    task = _task(data, 128, device)
    model = HyperPlanes.from_pretrained("small").to(device)
    plain = HyperPlanes.from_pretrained("small").to(device)
    plain.config = replace(plain.config, symmetric=False)
    ways = {
        "adapting": lambda: model.adapt(task.support),
        "adapting, no search for symmetry": lambda: plain.adapt(task.support),
        f"{steps} steps": lambda: model.fine_tune(task.support, steps),
    }
    rows: list[Row] = []
    for name, way in ways.items():
        way() if not name.endswith("steps") else model.fine_tune(task.support, 2)
        seconds, adapted = timed(way)
        images = adapted.render(task.query.cameras).images.clamp(0, 1)
        rows.append(
            {"name": f"small, {name}", "seconds": seconds, "psnr": float(psnr(images, task.query.images).mean())}
        )
        print(rows[-1], flush=True)
    return rows


def training(data: Tasks, device: torch.device, repeats: int) -> list[Row]:
    """Rows for training steps of `small` with few and with many rays, on objects that are already prepared."""
    settings, rows = preset("small").training, list[Row]()
    data = _Resized(data, 128)
    for rays in (settings.rays, 16 * settings.rays):
        model = HyperPlanes.from_pretrained("small").to(device)
        rates = {f"{name}learning_rate": 1e-6 for name in ("", "muon_", "hypernetwork_")}
        trainer = Trainer(model, data, replace(settings, prefetch=0, rays=rays, **rates))
        batch = trainer.loader.batch(0)
        trainer.loader.batch = lambda _, batch=batch: batch  # type: ignore[method-assign]
        taken = interleaved({"step": trainer.take_step}, repeats)["step"].wall
        rows.append({"name": f"small, step of {settings.tasks} x {rays} rays", "seconds": statistics.median(taken)})
        print(rows[-1], flush=True)
    return rows
