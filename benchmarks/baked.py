"""Compare baked voxels with the field that they were baked from: PSNR on query views, and time.

    python -m benchmarks baked --data data/cars data/chairs --json FILE
    python -m benchmarks baked --suite cc0 --counts 5 25 --json FILE

The model adapts to some views of each held-out object. Query views are rendered from its field, from the voxels as
baked, and from the voxels after they are fitted to the support views. The reference for all times is the field, in the
same run.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import timed
from benchmarks.views import add_data_options, suite_folders
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.base import Pictures
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.data import open_dataset
from hyperplanes.data.support import FarthestSupport
from hyperplanes.export.baking import BakedScene, bake, default_side
from hyperplanes.export.voxel_fitting import VOXEL_STEPS, fit_voxels, render_guide
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task

__all__ = ["main"]


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks baked", description=__doc__)
    add_data_options(parser)
    parser.add_argument("--counts", type=positive, nargs="+", default=[25], help="numbers of support views")
    parser.add_argument("--objects", type=positive, default=3, help="number of objects per data set")
    parser.add_argument("--query", type=positive, default=3, help="number of query views per object")
    parser.add_argument("--side", type=positive, help="voxels per axis (default: as for exported pages)")
    parser.add_argument("--fit", type=int, default=VOXEL_STEPS, help="steps for fitting voxels (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="one object and few steps, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.counts, chosen.objects, chosen.query, chosen.side, chosen.fit = [3], 1, 1, 32, 2
    model = HyperPlanes.from_pretrained(find_checkpoint(Path(chosen.checkpoint)))
    rows = []
    for _, path in suite_folders(parser, chosen):
        data = open_dataset(path)
        names = sorted(data.names("test"))[: chosen.objects]
        for count in chosen.counts:
            shown = FarthestSupport(data, count, chosen.query)
            found = [measure(model, shown.task(name), chosen.side, chosen.fit) for name in names]
            height, width = shown.task(names[0]).support.size
            row: Row = {"name": path.resolve().name, "views": count, "objects": len(names), "size": f"{width}x{height}"}
            row |= {key: statistics.fmean(each[key] for each in found) for key in found[0]}
            row["worst"] = min(each["fitted"] - each["field"] for each in found)
            print(row, flush=True)
            rows.append(row)
    return finish("baked", rows, chosen.json)


def measure(model: HyperPlanes, task: Task, side: int | None, fit: int) -> dict[str, float]:
    """For one object, the PSNR of the field, the voxels and the fitted voxels, and the times of baking and rendering.

    The time of a view is the mean over the query views.
    """
    adapted, cameras = model.adapt(task.support).without_residuals(), task.query.cameras
    adapted.render(task.query[:1].cameras)  # compiles kernels and refines the occupancy before the measurement
    field_seconds, by_field = timed(lambda: adapted.render(cameras))
    bake_seconds, baked = timed(lambda: bake(adapted, side=side or default_side(task.support.size)))
    guide_seconds, guide = timed(lambda: render_guide(adapted, task.support))
    alone = fit_voxels(baked, task.support, steps=fit) if guide else None
    fit_seconds, fitted = timed(lambda: fit_voxels(baked, task.support, guide=guide, steps=fit))
    scene = BakedScene(fitted)
    scene.render(task.query[:1].cameras)
    voxel_seconds, by_voxels = timed(lambda: scene.render(cameras))
    plain = BakedScene(baked).render(cameras)

    def quality(pictures: Pictures) -> float:
        return float(psnr(pictures.images.clamp(0, 1), task.query.images).mean())

    views = len(task.query)
    return {
        "field": quality(by_field),
        "baked": quality(plain),
        "fitted": quality(by_voxels),
        "fitted_without_guide": quality(BakedScene(alone).render(cameras) if alone else by_voxels),
        "field_ms": 1e3 * field_seconds / views,
        "voxels_ms": 1e3 * voxel_seconds / views,
        "bake_seconds": bake_seconds,
        "fit_seconds": guide_seconds + fit_seconds,
    }
