"""How fast points are projected onto planes and colours sampled there, against two ways of doing it with Kornia.

`kornia_loop` takes camera after camera: `PinholeCamera.project`, `normalize_pixel_coordinates`, `grid_sample`;
`kornia_batched` takes all cameras at once, with the points expanded to every camera. `torch` is our plain reference,
`cpu` the fused kernel on the images themselves, `cpu_packed` the same on 32 bits a pixel (the default where images
need no gradient), `triton` the fused kernel on a GPU. A lookup is one point on one plane, colours and coordinates out.
Points are random in a ball, the worst case for caches. For sampling alone the kernel gets pixels as points before an
identity camera, plane after plane, so that its own projection is in the time.

`speedup` is wall time over `kornia_loop`'s in the same round, with quartiles; `speedup_processor` compares the
processor time of both, which other work on the machine disturbs less. With `--threads 1` the two are alike.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import normalize_pixel_coordinates
from torch import Tensor
from torch.nn.functional import grid_sample

from benchmarks._timing import copy_bandwidth, interleaved, peak_bytes, ratio, table
from benchmarks.reporting import Row, environment
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.lookup import backends, lookup
from hyperplanes.geometry.lookup_torch import interpolate, place, project
from hyperplanes.geometry.storage import Packed, pack

__all__ = ["main"]

STANDARD = (25, 65_536, 200)  # planes, points, pixels a side
COLUMNS = ["part", "gradient", "way", "million_lookups_per_second", "speedup", "speedup_low", "speedup_high"]
COLUMNS += ["speedup_processor", "over_batched", "over_batched_processor", "peak_megabytes", "needed_megabytes"]
COLUMNS += ["copy_fraction"]


@dataclass(frozen=True)
class Scene:
    """Cameras around a ball of random points, with random 8-bit pictures."""

    cameras: PinholeCamera
    images: Tensor
    points: Tensor
    packed: Packed | None

    @classmethod
    def make(cls, planes: int, points: int, size: int, device: str = "cpu") -> Scene:
        """The same scene for the same numbers."""
        generator = torch.Generator().manual_seed(0)
        poses = camera.fibonacci_sphere(planes, 2.7)
        cameras = camera.to(camera.pinhole(camera.symmetric_intrinsics(size, size, 0.9), poses, size, size), device)
        images = torch.randint(0, 256, (planes, 3, size, size), generator=generator) / 255
        where = torch.randn(points, 3, generator=generator)
        where *= torch.rand(points, 1, generator=generator) ** (1 / 3) / where.norm(dim=-1, keepdim=True)
        return cls(cameras, images.to(device), where.to(device), pack(images) if device == "cpu" else None)

    @property
    def lookups(self) -> int:
        """Points times planes."""
        return len(self.points) * len(self.images)

    @property
    def singles(self) -> list[PinholeCamera]:
        """Every camera by itself, as the loop needs them."""
        return [camera.select(self.cameras, [view]) for view in range(len(self.images))]


Leaves = tuple[Tensor, ...]  # what gradients are asked for: points or coordinates, and images
Way = Callable[..., tuple[Tensor, ...]]


def ways(scene: Scene, part: str) -> tuple[Leaves, dict[str, Way]]:
    """The inputs of one part of the work, and everything that can do it.

    Args:
        scene: what is looked at.
        part: "projection", "sampling" or "both".

    Returns:
        Leaves, and functions of them by name; each returns all its results.
    """
    height = width = scene.images.shape[-1]
    matrices = camera.projection_matrices(scene.cameras)
    fused = [backend.name for backend in backends() if backend.available and backend.name != "torch"]
    fused = [name for name in fused if (name == "triton") == scene.points.is_cuda]
    singles = scene.singles

    def coordinates(ours: PinholeCamera, points: Tensor) -> Tensor:
        return normalize_pixel_coordinates(ours.project(points), height, width)

    def sample(images: Tensor, grid: Tensor) -> Tensor:
        return grid_sample(images, grid[:, :, None], align_corners=True)[..., 0]

    if part == "projection":
        none = scene.images[:, :0]
        found: dict[str, Way] = {
            "kornia_loop": lambda p, _: (torch.cat([coordinates(each, p[None]) for each in singles]),),
            "kornia_batched": lambda p, _: (coordinates(scene.cameras, p.expand(len(singles), -1, 3)),),
            "torch": lambda p, _: place(*project(p, matrices, None), height, width)[:1],
        }
        for name in fused:
            found[name] = partial(_coordinates_alone, matrices=matrices, images=none, backend=name)
        return (scene.points, scene.images), found
    if part == "sampling":
        pixels = project(scene.points, matrices, None)[0].transpose(0, 1).contiguous()
        grid = normalize_pixel_coordinates(pixels, height, width)
        found = {
            "kornia_loop": lambda g, _, i: (torch.cat([sample(i[v : v + 1], g[v : v + 1]) for v in range(len(i))]),),
            "kornia_batched": lambda g, _, i: (sample(i, g),),
            "torch": lambda g, _, i: (interpolate(i, g.transpose(0, 1), None),),
        }
        homogeneous = torch.nn.functional.pad(pixels, (0, 1), value=1.0)
        found |= {name: partial(_sampling_alone, backend=name) for name in fused}
        return (grid, homogeneous, scene.images), found
    found = {
        "kornia_loop": lambda p, i: _kornia_loop(p, i, singles, coordinates, sample),
        "kornia_batched": lambda p, i: _kornia_batched(p, i, scene.cameras, coordinates, sample),
        "torch": partial(_both, matrices=matrices, backend="torch"),
    }
    for name in fused:
        found[name] = partial(_both, matrices=matrices, backend=name)
    if "cpu" in fused:
        found["cpu_packed"] = partial(_both, matrices=matrices, backend="cpu", packed=scene.packed)
    return (scene.points, scene.images), found


def _kornia_loop(points: Tensor, images: Tensor, singles: list[PinholeCamera], coordinates, sample):
    found = []
    for view, ours in enumerate(singles):
        grid = coordinates(ours, points[None])
        found.append((sample(images[view : view + 1], grid), grid))
    return torch.cat([colours for colours, _ in found]), torch.cat([grid for _, grid in found])


def _kornia_batched(points: Tensor, images: Tensor, ours: PinholeCamera, coordinates, sample):
    grid = coordinates(ours, points.expand(len(images), -1, 3))
    return sample(images, grid), grid


def _both(points: Tensor, images: Tensor, matrices: Tensor, backend: str, packed: Packed | None = None):
    found = lookup(points, matrices, images, backend=backend, packed=packed)
    return found.colours, found.coordinates


def _coordinates_alone(points: Tensor, _: Tensor, matrices: Tensor, images: Tensor, backend: str):
    return (lookup(points, matrices, images, backend=backend).coordinates,)


def _sampling_alone(_: Tensor, points: Tensor, images: Tensor, backend: str):
    identity = torch.eye(3, 4, device=points.device)[None]
    planes = zip(points.unbind(0), images.split(1), strict=True)
    return tuple(lookup(pixels, identity, image, backend=backend).colours for pixels, image in planes)


def runs(leaves: Leaves, found: dict[str, Way], gradient: bool) -> dict[str, Callable[[], object]]:
    """The ways as calls without arguments, with the pull-back of ones to points and images if asked for."""
    if not gradient:
        return {name: partial(_forward, way, leaves) for name, way in found.items()}
    live = tuple(leaf.detach().clone().requires_grad_() for leaf in leaves)
    usable = {name: way for name, way in found.items() if name != "cpu_packed"}  # its images need no gradient
    pulls = {name: [torch.ones_like(result) for result in way(*live)] for name, way in usable.items()}
    return {name: partial(_forward_backward, way, live, pulls[name]) for name, way in usable.items()}


def _forward(way: Way, leaves: Leaves) -> tuple[Tensor, ...]:
    with torch.no_grad():
        return way(*leaves)


def _forward_backward(way: Way, leaves: Leaves, pulls: list[Tensor]) -> tuple[Tensor | None, ...]:
    return torch.autograd.grad(way(*leaves), leaves, pulls, allow_unused=True)


def needed_bytes(scene: Scene, part: str, gradient: bool, way: str) -> int:
    """What must be read and written at least once: points, planes, results; with a gradient theirs too.

    Args:
        scene: what is looked at.
        part: of the work.
        gradient: whether the pull-back is included.
        way: packed pictures are a third of the size.
    """
    per_lookup = {"projection": 8 + 1, "sampling": 8 + 12, "both": 12 + 8 + 1}[part]
    planes = 0 if part == "projection" else scene.images.numel() * 4 // (3 if way == "cpu_packed" else 1)
    once = scene.lookups * per_lookup + planes + (scene.points.numel() * 4 if part != "sampling" else 0)
    return 2 * once + planes if gradient else once


def measure(scene: Scene, part: str, gradient: bool, repeats: int, bandwidth: float | None) -> list[Row]:
    """A row for every way of doing one part, all in interleaved repetitions.

    Args:
        scene: what is looked at.
        part: "projection", "sampling" or "both".
        gradient: with the pull-back to points and images.
        repeats: rounds.
        bandwidth: of a copy on this machine, in bytes a second; without it, memory is not looked at.
    """
    calls = runs(*ways(scene, part), gradient)
    times = interleaved(calls, repeats)
    rows = []
    for name, taken in times.items():
        middle = statistics.median(taken.wall)
        row: Row = {"part": part, "gradient": gradient, "way": name, "planes": len(scene.images)}
        row |= {"points": len(scene.points), "resolution": scene.images.shape[-1], "seconds": middle}
        row["processor_seconds"] = statistics.median(taken.processor)
        row["million_lookups_per_second"] = scene.lookups / middle / 1e6
        if not name.startswith("kornia"):
            loop, batched = times["kornia_loop"], times["kornia_batched"]
            row |= ratio(loop.wall, taken.wall)
            row["speedup_processor"] = ratio(loop.processor, taken.processor)["speedup"]
            row["over_batched"] = ratio(batched.wall, taken.wall)["speedup"]
            row["over_batched_processor"] = ratio(batched.processor, taken.processor)["speedup"]
        if bandwidth:
            needed = needed_bytes(scene, part, gradient, name)
            row["needed_megabytes"] = needed / 1e6
            row["copy_fraction"] = needed / middle / bandwidth
            row["peak_megabytes"] = peak_bytes(calls[name]) / 1e6
        rows.append(row)
    return rows


def sweep(repeats: int, quick: bool) -> list[Row]:
    """Growth with planes, points and resolution, one at a time from the standard setting."""
    planes, points, size = STANDARD
    points //= 4
    counts = [1, 25, 200] if quick else [1, 2, 5, 10, 25, 50, 100, 200]
    amounts = [4096, 65_536] if quick else [1024, 4096, 16_384, 65_536, 262_144]
    sizes = [64, 1024] if quick else [64, 128, 256, 512, 1024]
    settings = [("planes", (n, points, size)) for n in counts]
    settings += [("points", (planes, n, size)) for n in amounts]
    settings += [("resolution", (planes, points, n)) for n in sizes]
    rows = []
    for axis, setting in settings:
        rows += [row | {"sweep": axis} for row in measure(Scene.make(*setting), "both", False, repeats, None)]
    return rows


def plot(rows: list[Row], path: Path, title: str) -> None:
    """The standard setting as bars, the sweeps as lines, in one picture.

    Args:
        rows: of `main`.
        path: of the picture.
        title: the machine, in words.
    """
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row["way"] for row in rows))
    colours = dict(zip(names, ["#9aa0a6", "#5f6368", "#7baaf7", "#1a73e8", "#0b3d91", "#188038"], strict=False))
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    figure.suptitle(title, fontsize=11)
    grid = figure.add_gridspec(2, 3)
    bars = figure.add_subplot(grid[0, :])
    groups = [(part, pull) for pull in (False, True) for part in ("projection", "sampling", "both")]
    for index, name in enumerate(names):
        for place_, (part, pull) in enumerate(groups):
            found = [r for r in rows if (r["part"], r["gradient"], r["way"]) == (part, pull, name) and "sweep" not in r]
            for row in found:
                value = float(row["million_lookups_per_second"])
                bars.bar(place_ + 0.14 * (index - 2), value, 0.13, color=colours[name])
                bars.text(place_ + 0.14 * (index - 2), value, f"{value:.3g}", ha="center", va="bottom", fontsize=7)
        bars.bar(0, 0, color=colours[name], label=name)
    labels = [part + ("\nwith gradient" if pull else "\nforward") for part, pull in groups]
    bars.set_xticks(range(len(groups)), labels)
    planes, points, size = STANDARD
    bars.set_title(f"{planes} planes of {size} x {size} pixels, {points:,} points")
    bars.set_ylabel("million lookups / s")
    bars.legend(ncols=len(names), fontsize=8, loc="upper center")
    bars.margins(y=0.2)
    for index, axis in enumerate(("planes", "points", "resolution")):
        lines = figure.add_subplot(grid[1, index])
        for name in names:
            found = [row for row in rows if row.get("sweep") == axis and row["way"] == name]
            lines.plot(
                [row[axis] for row in found],
                [1e3 * float(row["seconds"]) for row in found],
                "o-",
                ms=3,
                color=colours[name],
            )
        lines.set(xscale="log", yscale="log", xlabel=axis, ylabel="ms (both, forward)")
        lines.grid(alpha=0.3, which="both")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(arguments: list[str]) -> int:
    """Measure, print the table, and write JSON and a plot where asked.

    Args:
        arguments: --quick for a rough answer within a minute, --json FILE, --plot FILE, --threads N.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks lookup", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions and settings, within a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the rows go")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="where a picture of them goes (PNG)")
    parser.add_argument("--threads", type=int, metavar="N", help="of PyTorch and of the kernels")
    options = parser.parse_args(arguments)
    if options.threads:
        torch.set_num_threads(options.threads)
    about = environment() | {"load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None}
    bandwidth = copy_bandwidth(128 if options.quick else 512)
    about["copy_gigabytes_per_second"] = bandwidth / 1e9
    title = f"{about['processor']}, {about['threads']} threads, commit {about['commit']}, load {about['load']:.1f}"
    print(f"{title}; a copy moves {bandwidth / 1e9:.1f} GB/s")
    repeats = 3 if options.quick else 15
    scene = Scene.make(*STANDARD)
    rows: list[Row] = []
    for gradient in (False, True):
        for part in ("projection", "sampling", "both"):
            rows += measure(scene, part, gradient, repeats, bandwidth)
    print(table(rows, COLUMNS))
    swept = sweep(2 if options.quick else 7, options.quick)
    print("\n" + table(swept, ["sweep", "planes", "points", "resolution", "way", "seconds", *COLUMNS[3:9]]))
    rows += swept
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        content = {"benchmark": "lookup", **about, "rows": rows}
        options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if options.plot:
        plot(rows, options.plot, title)
    return 0
