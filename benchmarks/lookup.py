"""Compare the speed of lookups (projecting points onto ImagePlanes and sampling colours there) with Kornia's functions.

`kornia_loop` uses one camera after the other: `PinholeCamera.project`, `normalize_pixel_coordinates`, `grid_sample`.
`kornia_batched` uses all cameras at once, with the points expanded to every camera. `torch` is the reference in PyTorch
of this package, `cpu` its fused kernel on the images, `cpu_packed` the same kernel on images packed into 32 bits per
pixel (the default if images need no gradient), and `triton` its fused kernel on a GPU. A lookup is one point on one
plane, and returns a colour and coordinates. Points are random in a ball, which is the worst case for caches. Sampling
alone starts from coordinates as Kornia normalises them. Each implementation is called three times in a row before the
next one, because real work calls it repeatedly.

`speedup` is the wall time of `kornia_loop` divided by that of the implementation in the same round, with quartiles.
`speedup_processor` is the same for processor time, which other processes disturb less. With `--threads 1` the two are
similar.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

import torch

from benchmarks.parts.load import load_at_start
from benchmarks.parts.lookup_plot import plot
from benchmarks.parts.lookup_ways import STANDARD, Scene, needed_bytes, runs, ways
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, write_rows
from benchmarks.parts.timing import add_device_option, copy_bandwidth, interleaved, peak_bytes, ratio, table
from hyperplanes.utilities.machine.environment import environment

__all__ = ["main"]

CALLS = 3  # in a row

COLUMNS = ["part", "gradient", "way", "million_lookups_per_second", "speedup", "speedup_low", "speedup_high"]
COLUMNS += ["speedup_processor", "over_batched", "over_batched_processor", "peak_megabytes", "needed_megabytes"]
COLUMNS += ["copy_fraction"]


def measure(scene: Scene, part: str, gradient: bool, repeats: int, bandwidth: float | None) -> list[Row]:
    """A row for each implementation of one part of a lookup, with interleaved repetitions.

    Args:
        scene: cameras, images and points.
        part: "projection", "sampling" or "both".
        gradient: also compute the gradients of points and images.
        repeats: number of rounds.
        bandwidth: of a copy on this machine, in bytes per second; None measures no memory.
    """
    calls = runs(*ways(scene, part), gradient)
    times = interleaved(calls, repeats, row=CALLS)
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
            row["peak_megabytes"] = peak_bytes(calls[name], scene.points.device.type) / 1e6
        rows.append(row)
    return rows


def sweep(repeats: int, quick: bool, device: str) -> list[Row]:
    """Rows for other numbers of planes, points or pixels; one of them varies, the others are standard.

    The standard number of points is a quarter of that of STANDARD.
    """
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
        rows += [row | {"sweep": axis} for row in measure(Scene.make(*setting, device), "both", False, repeats, None)]
    return rows


def main(arguments: list[str]) -> int:
    """Measure, print the tables, and write JSON and a plot if the options ask for them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks lookup", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions and settings, within a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="PNG file to plot them to")
    parser.add_argument("--threads", type=positive, metavar="N", help="number of threads of PyTorch and the kernels")
    add_device_option(parser, "cpu")
    options = parser.parse_args(arguments)
    if options.threads:
        torch.set_num_threads(options.threads)
    about, load = environment(), load_at_start()
    bandwidth = copy_bandwidth(128 if options.quick else 512, options.device)
    where = f"{about['processor']}, {about['threads']} threads" if options.device == "cpu" else about["gpu"]
    title = f"{where}, commit {about['commit']}, load {load:.1f}"
    print(f"{title}; a copy moves {bandwidth / 1e9:.1f} GB/s")
    repeats = 3 if options.quick else 15
    scene = Scene.make(*STANDARD, options.device)
    rows: list[Row] = []
    for gradient in (False, True):
        for part in ("projection", "sampling", "both"):
            rows += measure(scene, part, gradient, repeats, bandwidth)
    print(table(rows, COLUMNS))
    swept = sweep(2 if options.quick else 7, options.quick, options.device)
    print("\n" + table(swept, ["sweep", "planes", "points", "resolution", "way", "seconds", *COLUMNS[3:9]]))
    rows += swept
    if options.json:
        write_rows("lookup", rows, options.json, options.device, copy_gigabytes_per_second=bandwidth / 1e9)
    if options.plot:
        plot(rows, options.plot, title)
    return 0
