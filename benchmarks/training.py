"""Compare training with packed samples and the paper's dense training: rays per second, parts of a step, and memory.

Both train the same network from the same initial weights on the same objects, with the same number of rays per step.
Dense training draws rays from whole query images, and evaluates a coarse and a fine network at 64 and 192 samples per
ray. Packed training draws rays that hit the visual hull of the support masks, and evaluates samples in this hull. With
`--curves STEPS`, both instead train the paper's networks for this number of steps, and are evaluated in the same way on
held-out objects.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.parts.objects import held_out
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import add_device_option, interleaved, peak_bytes, ratio, timed
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.presets import Preset, preset
from hyperplanes.rendering.renderer import Hierarchical, RayMarching
from hyperplanes.training import Trainer
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.utilities.images.plots import new_figure, save_figure
from hyperplanes.views import Task

__all__ = ["main"]

DENSE = Hierarchical(64, 128)
RAYS = 512
UNSEEN = 2  # number of held-out objects


class Objects:
    """Tasks in memory; the last UNSEEN by name are held out."""

    def __init__(self, tasks: list[Task]) -> None:
        self.tasks = {task.name: task for task in tasks}

    def names(self, split: str) -> list[str]:
        """The names of the objects of a split, "train" or "test"."""
        names = sorted(self.tasks)
        return names[-UNSEEN:] if split == "test" else names[:-UNSEEN]

    def task(self, name: str) -> Task:
        """One object."""
        return self.tasks[name]


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks training", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only the preset quick, few steps")
    parser.add_argument("--curves", type=int, metavar="STEPS", help="instead train both for STEPS steps (slow)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="PNG file to plot the curves to")
    add_device_option(parser, "cpu")
    options = parser.parse_args(arguments)
    rows: list[Row] = []
    if options.curves:
        chosen = preset("paper-128-brief")
        rows = curves(chosen, Objects(held_out(10, chosen.resolution, device=options.device)), options.curves)
        if options.plot:
            plot(rows, options.plot)
        return finish("training", rows, options.json, options.device)
    for name in ("quick",) if options.quick else ("quick", "small-paper", "paper-128"):
        chosen = preset(name).by_protocol("ray_marching")
        tasks = held_out(2 + UNSEEN, chosen.resolution, device=options.device)
        rows += compare(name, chosen, Objects(tasks), 3 if options.quick else 8, options.device)
    return finish("training", rows, options.json, options.device)


def both(chosen: Preset, objects: Objects) -> dict[str, Trainer]:
    """A trainer for each kind of training, with the same initial weights and with all objects prepared."""
    device, trainers = objects.task(objects.names("test")[0]).support.images.device, {}
    for path, sampling in (("packed", chosen.model.sampling), ("dense", DENSE)):
        model = HyperPlanes(replace(chosen.model, sampling=sampling)).to(device)
        trainers[path] = Trainer(
            model, objects, replace(chosen.training, rays=RAYS, tasks=1, warmup=10, final_rate_factor=1.0)
        )
        for name in objects.names("train"):
            trainers[path].loader.get(name)
    return trainers


def compare(name: str, chosen: Preset, objects: Objects, steps: int, device: str) -> list[Row]:
    """Rows for rays per second and memory of both, measured alternately, and on a CPU for the parts of a step."""
    trainers = both(chosen, objects)
    times = interleaved({path: each.take_step for path, each in trainers.items()}, steps, seconds=120)
    row: Row = {"name": f"packed training, {name}, {RAYS} rays a step"}
    row["rays_per_second"] = RAYS / statistics.median(times["packed"].wall)
    row["reference_rays_per_second"] = RAYS / statistics.median(times["dense"].wall)
    row |= ratio(times["dense"].wall, times["packed"].wall)
    row["speedup_processor"] = ratio(times["dense"].processor, times["packed"].processor)["speedup"]
    row["steps"] = len(times["packed"].wall)
    row["peak_megabytes"] = peak_bytes(trainers["packed"].take_step, device) / 1e6
    row["reference_peak_megabytes"] = peak_bytes(trainers["dense"].take_step, device) / 1e6
    if device != "cpu":
        return [row]
    return [row, *(part for path, each in trainers.items() for part in step_parts(f"{name}, {path}", each))]


def step_parts(name: str, trained: Trainer) -> list[Row]:
    """Rows for the seconds of the parts of one step, with one thread, because the profiler records only one."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.profiler.profile(record_shapes=False) as profiler:
            trained.take_step()
    finally:
        torch.set_num_threads(threads)
    return [
        {
            "name": f"part of a step, {name}: {event.key.removeprefix('step:')}",
            "seconds": event.cpu_time_total / 1e6,
        }
        for event in profiler.key_averages()
        if event.key.startswith("step:")
    ]


def curves(chosen: Preset, objects: Objects, steps: int) -> list[Row]:
    """Rows for the PSNR on held-out objects after equal numbers of steps of both, and the seconds that they took."""
    trainers = both(chosen, objects)
    spent = dict.fromkeys(trainers, 0.0)
    rows: list[Row] = []
    for step in range(1, steps + 1):
        for path, each in trainers.items():
            spent[path] += timed(each.take_step)[0]
            if step % max(1, steps // 10) == 0:
                row: Row = {"name": f"curve, {path}", "path": path, "step": step, "seconds": spent[path]}
                rows.append(row | {"psnr": unseen_psnr(each, objects)})
    return rows


def unseen_psnr(trained: Trainer, objects: Objects) -> float:
    """PSNR of query views of the held-out objects, by the default protocol for both kinds of training."""
    found = []
    for name in objects.names("test"):
        task = objects.task(name)
        query = task.query[3::8]
        pictures = trained.model.adapt(task.support).render(query.cameras, RayMarching())
        found.append(psnr(pictures.images.clamp(0, 1), query.images))
    return float(torch.cat(found).mean())


def plot(rows: list[Row], path: Path) -> None:
    """Plot the rows of `curves`, over steps and over seconds."""
    figure = new_figure(10, 3.8)
    for axes, axis in zip(figure.subplots(1, 2, sharey=True), ("step", "seconds"), strict=True):
        for name, colour in (("packed", "#1a73e8"), ("dense", "#9aa0a6")):
            found = [row for row in rows if row["path"] == name]
            axes.plot([float(r[axis]) for r in found], [float(r["psnr"]) for r in found], "o-", ms=3, color=colour,
                      label={"packed": "packed (default)", "dense": "dense, 64 + 192 a ray (paper)"}[name])  # fmt: skip
        axes.set(xlabel={"step": "steps of 512 rays", "seconds": "seconds"}[axis])
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="lower right")
    figure.axes[0].set_ylabel("PSNR of unseen objects, dB")
    save_figure(figure, path)
