"""Compare rendering by the default protocol with the paper's, with the same weights on the same held-out objects.

The paper's protocol evaluates a coarse and a fine network, at 64 and 192 samples per ray. It is measured twice: with
the kernels of this package, and with the layers of its networks multiplied by PyTorch. The default protocol renders the
same field only where it is not empty. All run alternately in one process. The objects are procedural cars with seeds
that no training of this project uses.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from benchmarks.parts.objects import held_out
from benchmarks.parts.rendering_growth import growth, plot_growth
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import add_device_option, timed, without
from hyperplanes.adaptation.base import AdaptedField, Pictures
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.export.baking import BakedScene, bake
from hyperplanes.fields.base import Field
from hyperplanes.fields.layers import PackedLayers
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.rendering.compositing import composite_packed, packed_weights
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.renderer import Hierarchical, RayMarching, render
from hyperplanes.rendering.sampling.marching import march
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task, Views

__all__ = ["main"]

CHECKPOINT = Path(__file__).parent / "weights" / "paper-network"
PAPER = Hierarchical(64, 128)
RAYS_OF_A_LARGE_VIEW = 8192
VIEWS = {64: 3, 128: 3, 200: 2, 400: 1}  # pixels per side: number of views


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks rendering", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="64 pixels per side only, in about a minute")
    parser.add_argument(
        "--sizes",
        type=int,
        nargs="+",
        choices=VIEWS,
        help="pixels per side, and only these rows (default: all sizes, 50 views, and peak memory)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="a trained model (default: %(default)s)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="PNG file to plot the growth of the time to")
    add_device_option(parser, "cpu")
    parser.add_argument("--memory", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    model = HyperPlanes.from_pretrained(options.checkpoint).to(options.device)
    if options.memory:
        return large_view(model)
    rows: list[Row] = []
    sizes = {64: 2} if options.quick else {size: VIEWS[size] for size in options.sizes or VIEWS}
    for size, count in sizes.items():
        print(f"{size} pixels", file=sys.stderr)
        tasks = held_out(count, size, device=options.device)
        rows += compare(model, tasks)
        rows += parts(model, tasks[0])
        rows += [] if options.quick or size > 200 else baked(model, tasks[0])
    if not options.quick and not options.sizes:
        rows.append(fifty_views(model, held_out(1, 200, device=options.device)[0]))
        rows.append(peak_memory(options.checkpoint, options.device))
    if options.plot:
        grown = growth(model, options.quick)
        plot_growth(grown, options.plot)
        rows += grown
    return finish("rendering", rows, options.json, options.device)


@dataclass(frozen=True)
class PaperView:
    """One view rendered by the paper's protocol.

    If the view has many rays, an evenly spaced subset is rendered, and the time is scaled.

    Attributes:
        seconds: for the whole view.
        samples: per ray.
        error: mean squared error over the rendered rays.
        chosen: flat pixel indices of the rendered rays.
        truth: true colours of these pixels.
    """

    seconds: float
    samples: float
    error: float
    chosen: Tensor
    truth: Tensor

    @classmethod
    def of(cls, adapted: AdaptedField, query: Views, view: int) -> PaperView:
        """Render a view, or a subset of its rays."""
        height, width = query.size
        total = height * width
        chosen = torch.arange(0, total, max(1, total // RAYS_OF_A_LARGE_VIEW) if total > 128 * 128 else 1)
        pixels = pixel_grid(height, width)[chosen]
        rays = cast(query.cameras, torch.full_like(chosen, view), pixels, query.bounds, near_far=PAPER.near_far)
        seconds, seen = timed(
            lambda: render(adapted.field, rays, PAPER, proposal=adapted.proposal, differentiable=False)
        )
        truth = query.images[view].flatten(1).T[chosen]
        error = float((seen.colour - truth).square().mean())
        return cls(seconds * total / len(chosen), seen.samples / len(chosen), error, chosen, truth)

    def error_of(self, pictures: Pictures) -> float:
        """The mean squared error of another rendering of the view, over the same rays."""
        return float((pictures.images[0].flatten(1).T[self.chosen] - self.truth).square().mean())


PROTOCOLS = {
    "default protocol": {},
    "one ray a pixel": {"antialias": False},
    "one ray a pixel in single precision": {"antialias": False, "mixed_precision": False},
}
"""Variants of the default protocol, as options of `AdaptedField.render`.

The paper's protocol uses one ray per pixel, in single precision.
"""


def compare(model: HyperPlanes, tasks: list[Task]) -> list[Row]:
    """Render one view of each object by all protocols; the default protocol before and after the paper's."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in PROTOCOLS}
    for number, task in enumerate(tasks):
        view = (7 * number + 3) % len(task.query)
        adapt, adapted = timed(lambda task=task: model.adapt(task.support))
        refine, _ = timed(lambda adapted=adapted: adapted.refined_occupancy)
        one = camera.select(task.query.cameras, [view])
        pixels = task.query.size[0] * task.query.size[1]

        def ours(name: str, adapted: AdaptedField = adapted, one: PinholeCamera = one) -> tuple[float, Pictures]:
            return timed(lambda: adapted.render(one, **PROTOCOLS[name]))

        if number == 0:  # compiles kernels before the measurement
            for name in PROTOCOLS:
                ours(name)
        before = {name: ours(name) for name in PROTOCOLS}
        paper = PaperView.of(adapted, task.query, view)
        with without(PackedLayers, "takes"):
            plain = PaperView.of(adapted, task.query, view)
        for name, (first, pictures) in before.items():
            again, _ = ours(name)
            row = {"seconds": (first + again) / 2, "reference_seconds": paper.seconds, "plain_seconds": plain.seconds}
            row |= {"samples": pictures.samples / pixels, "reference_samples": paper.samples}
            row |= {"error": paper.error_of(pictures), "reference_error": paper.error}
            found[name].append(row | {"adapt_seconds": adapt, "refine_seconds": refine})
    return [_summary(name, tasks[0].query.size[0], rows) for name, rows in found.items()]


def _summary(name: str, size: int, rows: list[dict[str, float]]) -> Row:
    """One row for the results of several views."""
    ratios, plainly = ([row[name] / row["seconds"] for row in rows] for name in ("reference_seconds", "plain_seconds"))
    ours, paper = (statistics.fmean(_decibels(row[error]) for row in rows) for error in ("error", "reference_error"))
    median = {
        key: statistics.median(row[key] for row in rows)
        for key in ("seconds", "reference_seconds", "plain_seconds", "adapt_seconds", "refine_seconds")
    }
    return {
        "name": f"{name}, {size}x{size}, one view",
        **median,
        "speedup_over_plain": statistics.median(plainly),
        "speedup": statistics.median(ratios),
        "speedup_lowest": min(ratios),
        "speedup_highest": max(ratios),
        "samples_a_ray": statistics.fmean(row["samples"] for row in rows),
        "reference_samples_a_ray": statistics.fmean(row["reference_samples"] for row in rows),
        "psnr": ours,
        "reference_psnr": paper,
        "psnr_loss": paper - ours,
    }


def _decibels(error: float) -> float:
    return -10 * torch.log10(torch.tensor(error)).item()


def fifty_views(model: HyperPlanes, task: Task) -> Row:
    """The seconds to adapt to the support views and to render the views of all cameras by the default protocol."""
    cameras = camera.concatenate([task.support.cameras, task.query.cameras])
    seconds, _ = timed(lambda: model.adapt(task.support).render(cameras))
    size = task.query.size[0]
    return {"name": f"default protocol, {size}x{size}, adapting and fifty views", "seconds": seconds}


def parts(model: HyperPlanes, task: Task) -> list[Row]:
    """The shares of sampling, lookup, network and compositing in the time of one view by the default protocol."""
    adapted = model.adapt(task.support)
    occupancy, query = adapted.refined_occupancy, task.query
    field, sampling = adapted.field, adapted.sampling
    if not isinstance(field, Field) or not isinstance(sampling, RayMarching):
        return []
    one = camera.select(query.cameras, [3])
    with torch.no_grad():
        find, live = timed(lambda: footprint(occupancy, one)[0].flatten().nonzero()[:, 0])
        rays = cast(one, torch.zeros_like(live), pixel_grid(*query.size)[live], query.bounds)
        walk, samples = timed(lambda: march(rays, occupancy, 2 * query.bounds.radius / sampling.steps))
        asked = min(len(samples), adapted.render(one).samples)
        part = samples[torch.arange(asked)]
        directions = rays.directions[part.ray]
        points = rays.origins[part.ray] + part.distances[:, None] * directions
        look = sum(timed(lambda p=p: field.target.inputs(p, field.planes, field.bounds))[0] for p in points.split(8192))
        both = [
            timed(lambda p=p, d=d: field(p, d)) for p, d in zip(points.split(8192), directions.split(8192), strict=True)
        ]
        colour, density = (torch.cat(values) for values in zip(*(answer for _, answer in both), strict=True))

        def assemble() -> None:
            weights = packed_weights(density * part.step, part.ray, len(rays))
            composite_packed(colour, weights, part.distances, part.ray, len(rays))

        compose, _ = timed(assemble)
    ask = sum(seconds for seconds, _ in both)
    shares = {"sampling": find + walk, "lookup": look, "network": max(ask - look, 0.0), "compositing": compose}
    total = sum(shares.values())
    return [
        {"name": f"share of {part_name}, {query.size[0]}x{query.size[1]}", "share": seconds / total, "seconds": seconds}
        for part_name, seconds in shares.items()
    ]


def baked(model: HyperPlanes, task: Task) -> list[Row]:
    """Compare baked voxels with the field that they were baked from: speed and PSNR."""
    adapted = model.adapt(task.support)
    query = task.query[::8]
    _ = adapted.refined_occupancy
    baking, field = timed(lambda: bake(adapted))
    scene = BakedScene(field)
    scene.render(camera.select(query.cameras, [0]))  # compiles kernels before the measurement
    slow, fast = [], []
    pictures: list[Pictures] = []
    for _ in range(2):
        seconds, before = timed(lambda: adapted.render(query.cameras))
        slow.append(seconds / len(query))
        seconds, after = timed(lambda: scene.render(query.cameras))
        fast.append(seconds / len(query))
        pictures = [before, after]
    quality = [float(psnr(each.images.clamp(0, 1), query.images).mean()) for each in pictures]
    return [
        {
            "name": f"baked, {query.size[0]}x{query.size[1]}",
            "seconds": statistics.median(fast),
            "reference_seconds": statistics.median(slow),
            "speedup": statistics.median(a / b for a, b in zip(slow, fast, strict=True)),
            "psnr": quality[1],
            "reference_psnr": quality[0],
            "psnr_loss": quality[0] - quality[1],
            "baking_seconds": baking,
            "rows": len(field.values),
        }
    ]


def peak_memory(checkpoint: Path, device: str) -> Row:
    """Peak resident memory of a process that adapts to 25 support views and renders one view of 800x800."""
    command = [sys.executable, "-m", "benchmarks", "rendering", "--memory", "--checkpoint", str(checkpoint)]
    command += ["--device", device]
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    seconds, peak = answer.split()[-2:]
    return {
        "name": "default protocol, 800x800, one view with adapting",
        "seconds": float(seconds),
        "peak_gib": float(peak),
    }


def large_view(model: HyperPlanes) -> int:
    """The work of the process that `peak_memory` starts: prints its seconds and its peak memory in GiB."""
    task = held_out(1, 200)[0]
    one = camera.resized(camera.select(task.query.cameras, [3]), 800, 800)
    seconds, _ = timed(lambda: model.adapt(task.support).render(one))
    print(seconds, resident_peak() / 2**30)
    return 0


def resident_peak() -> int:
    """The peak resident memory of this process so far, in bytes.

    On Linux it is read from /proc, because `getrusage` includes the memory of the parent process at the fork.
    """
    status = Path("/proc/self/status")
    if status.exists():
        return int(status.read_text().split("VmHWM:")[1].split()[0]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
