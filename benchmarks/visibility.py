"""Compare the compiled kernel that finds which views see a point with plain PyTorch, and time the code that uses it.

    python -m benchmarks visibility --json FILE

The points are in the visual hull of a procedural car with 25 and with 50 views of 128 x 128 pixels. All functions are
measured alternately.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

import torch

from benchmarks.parts.objects import held_out
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import interleaved, ratio
from hyperplanes.adaptation.base import hull
from hyperplanes.geometry.chosen_views import Visibility
from hyperplanes.geometry.visibility.planes import VisibilityPlanes, choose_torch
from hyperplanes.geometry.volume import volume_of
from hyperplanes.views import join_views

__all__ = ["main"]

BEST, NEAREST = 8, 4


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks visibility", description=__doc__)
    parser.add_argument("--points", type=positive, default=20_000, help="number of points (default: %(default)s)")
    parser.add_argument("--size", type=positive, default=128, help="pixels per side (default: %(default)s)")
    parser.add_argument("--views", type=positive, nargs="+", default=[25, 50], help="numbers of views (default: 25 50)")
    parser.add_argument("--repeats", type=positive, default=15, help="repetitions (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="few points and pixels, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.points, chosen.size, chosen.views, chosen.repeats = 500, 32, [5], 2
    task, rows = held_out(1, chosen.size)[0], []
    views = join_views(task.support, task.query)
    for count in chosen.views:
        shown = views[:count]
        region = hull(shown, 64)
        generator = torch.Generator().manual_seed(0)
        inside = region.centres()
        points = inside[torch.randint(len(inside), (chosen.points,), generator=generator)]
        points = points + (torch.rand(points.shape, generator=generator) - 0.5) * region.voxel
        directions = torch.nn.functional.normalize(torch.randn(points.shape, generator=generator), dim=1)
        planes = VisibilityPlanes(shown.images, shown.cameras, shown.masks, region)

        def compiled(planes: VisibilityPlanes = planes, at=points, along=directions) -> Visibility:
            return planes.choose(at, along, best=BEST, nearest=NEAREST)

        def plain(planes: VisibilityPlanes = planes, at=points, along=directions) -> Visibility:
            with torch.no_grad():
                return choose_torch(planes, at, along, BEST, NEAREST + 1, planes.depth_opacity)

        first, second = compiled(), plain()
        agreeing = float((first.best.penalty - second.best.penalty).abs().lt(1e-3).float().mean())
        times = interleaved(
            {
                "choose, compiled": compiled,
                "choose, PyTorch": plain,
                "colours of all views": lambda planes=planes, at=points: planes.colours.lookup(at),
                "volume": lambda planes=planes: volume_of(planes),
            },
            chosen.repeats,
        )
        for name, found in times.items():
            seconds = statistics.median(found.wall)
            row: Row = {"name": name, "views": count, "seconds": seconds, "threads": torch.get_num_threads()}
            if name != "volume":
                row["microseconds_a_point"] = seconds / chosen.points * 1e6
            if name == "choose, compiled":
                row |= {**ratio(times["choose, PyTorch"].wall, found.wall), "agreeing": agreeing}
            rows.append(row)
    return finish("visibility", rows, chosen.json)
