"""Training by packed rays against the dense path of the paper: rays a second, parts of a step, and the curves.

Both train the same network from the same start on the same objects with the same number of rays a step. The dense path
draws its rays from whole query images and asks a coarse and a fine network at 64 + 192 places of each; the packed one
asks where the visual hull of the support masks leaves something to be seen.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.rendering import held_out
from benchmarks.reporting import Row, finish
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.metrics import psnr
from hyperplanes.presets import Preset, preset
from hyperplanes.rendering.renderer import Hierarchical, Marched
from hyperplanes.training import Trainer
from hyperplanes.views import Task

__all__ = ["main"]

DENSE = Hierarchical(64, 128)


class Objects:
    """Tasks in memory, the last one held out."""

    def __init__(self, tasks: list[Task]) -> None:
        self.tasks = {task.name: task for task in tasks}

    def names(self, split: str) -> list[str]:
        """The objects of a split."""
        names = sorted(self.tasks)
        return names[-1:] if split == "test" else names[:-1]

    def task(self, name: str) -> Task:
        """One object."""
        return self.tasks[name]


def main(arguments: list[str]) -> int:
    """Measure, print, and write the rows where asked.

    Args:
        arguments: --quick, --json FILE, --steps N.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks training", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the quick preset alone, few steps")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the rows go")
    parser.add_argument("--steps", type=int, default=40, help="of the curves (default: %(default)s)")
    options = parser.parse_args(arguments)
    rows: list[Row] = []
    for name in ("quick",) if options.quick else ("quick", "small", "paper-128"):
        chosen = preset(name)
        objects = Objects(held_out(4, chosen.resolution))
        steps = 6 if options.quick else options.steps
        rows += compare(name, chosen, objects, steps)
    return finish("training", rows, options.json)


def trainer(chosen: Preset, objects: Objects, sampling: Hierarchical | Marched) -> Trainer:
    """A training of the preset by one protocol, always from the same weights."""
    torch.manual_seed(0)
    model = HyperPlanes(replace(chosen.model, sampling=sampling))
    return Trainer(model, objects, replace(chosen.training, rays=512, tasks=1, warmup=0, final=1.0))


def compare(name: str, chosen: Preset, objects: Objects, steps: int) -> list[Row]:
    """Steps of both paths in turn: two packed ones to each dense one, so that both see the same machine."""
    dense, packed = trainer(chosen, objects, DENSE), trainer(chosen, objects, chosen.model.sampling)
    for each in (dense, packed):
        each.take_step()
        for task in objects.names("train"):
            each.warm(task)
    seconds: dict[str, list[float]] = {"dense": [], "packed": []}
    for _ in range(steps):
        for path, each in (("packed", packed), ("dense", dense)):
            begun = time.perf_counter()
            each.take_step()
            seconds[path].append(time.perf_counter() - begun)
    ratios = torch.tensor(seconds["dense"]) / torch.tensor(seconds["packed"])
    row: Row = {
        "name": f"packed training, {name}, 512 rays a step",
        "rays_per_second": 512 / float(torch.tensor(seconds["packed"]).median()),
        "reference_rays_per_second": 512 / float(torch.tensor(seconds["dense"]).median()),
        "speedup": float(ratios.median()),
        "speedup_lowest": float(ratios.min()),
        "speedup_highest": float(ratios.max()),
        "steps": steps,
    }
    ours, theirs = held_out_psnr(packed, objects), held_out_psnr(dense, objects)
    return [row | {"psnr": ours, "reference_psnr": theirs, "psnr_loss": theirs - ours}, *step_parts(name, packed)]


def held_out_psnr(trained: Trainer, objects: Objects) -> float:
    """PSNR of two query views of the held-out object after the steps so far, both by the default protocol."""
    task = objects.task(objects.names("test")[0])
    query = task.query[3::12]
    pictures = trained.model.adapt(task.support).render(query.cameras, Marched())
    return float(psnr(pictures.images.clamp(0, 1), query.images).mean())


def step_parts(name: str, trained: Trainer) -> list[Row]:
    """Seconds of the parts of one packed step."""
    with torch.profiler.profile(record_shapes=False) as profiler:
        trained.take_step()
    found: list[Row] = []
    for event in profiler.key_averages():
        if event.key.startswith("step:"):
            part = event.key.removeprefix("step:")
            found.append({"name": f"part of a step, {name}: {part}", "seconds": event.cpu_time_total / 1e6})
    return found
