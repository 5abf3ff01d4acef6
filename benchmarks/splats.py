"""Compare Gaussian splats with the baked voxels that they are made from: PSNR on query views, and time.

    python -m benchmarks splats --json FILE
    python -m benchmarks splats --scene SCENE

The objects are held-out procedural objects, or a posed scene. `small` adapts to the support views, 25 for procedural
objects. Its field is baked, the voxels are fitted, and splats are made from them and fitted, as in `hyperplanes export
--what splats`. Up to eight query views are compared.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from benchmarks.parts.objects import held_out
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import timed
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.data import read_task
from hyperplanes.export.baking import BakedScene, bake, default_side
from hyperplanes.export.splats import fit_splats, splats_of
from hyperplanes.export.voxel_fitting import VOXEL_STEPS, fit_voxels, render_guide
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task

__all__ = ["main"]

COMPARED = 8  # query views


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks splats", description=__doc__)
    parser.add_argument("--objects", nargs="+", default=["car", "chair"], help="classes (default: car chair)")
    parser.add_argument("--sizes", type=positive, nargs="+", default=[100], help="pixels per side (default: 100)")
    parser.add_argument("--scene", type=Path, help="a posed scene instead of these objects")
    parser.add_argument("--quick", action="store_true", help="a car of 48 pixels and few steps")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    model = HyperPlanes.from_pretrained("small")
    if chosen.quick:
        tasks = held_out(1, 48, 16)
    elif chosen.scene is not None:
        tasks = [read_task(chosen.scene)]
    else:
        tasks = [held_out(1, size, kind=kind)[0] for kind in chosen.objects for size in chosen.sizes]
    rows = [measure(model, task, *((4, 10) if chosen.quick else ())) for task in tasks]
    return finish("splats", rows, chosen.json)


def measure(model: HyperPlanes, task: Task, voxel_steps: int = VOXEL_STEPS, splat_steps: int = 160) -> Row:
    """Measure one object as a field, as voxels and as splats."""
    shown, asked = task.support, task.query[:COMPARED]
    field = model.adapt(shown).without_residuals()
    baked = bake(field, side=default_side(shown.size))
    fit_splats(splats_of(baked), shown, steps=1)  # compiles kernels before the measurement
    voxel_seconds, baked = timed(lambda: fit_voxels(baked, shown, steps=voxel_steps))
    guide = render_guide(BakedScene(baked), shown, size=shown.size)
    splat_seconds, splats = timed(lambda: fit_splats(splats_of(baked), shown, guide=guide, steps=splat_steps))
    scene = BakedScene(baked)
    scene.render(asked[:1].cameras)
    reference_seconds, voxels = timed(lambda: scene.render(asked.cameras).images)
    seconds, pictures = timed(lambda: splats.render(asked.cameras))
    whole = field.render(asked.cameras).images
    field_psnr, voxel_psnr, splat_psnr = (
        float(psnr(part.clamp(0, 1), asked.images).mean()) for part in (whole, voxels, pictures)
    )
    height, width = shown.size
    return {
        "name": f"splats, {task.name}, {width}x{height}, {len(shown)} views",
        "threads": torch.get_num_threads(),
        "splats": len(splats.means),
        "seconds": seconds / len(asked),
        "reference_seconds": reference_seconds / len(asked),
        "speedup": reference_seconds / seconds,
        "psnr": splat_psnr,
        "psnr_loss": voxel_psnr - splat_psnr,
        "voxel_psnr": voxel_psnr,
        "field_psnr": field_psnr,
        "fit_seconds": splat_seconds,
        "fit_voxels_seconds": voxel_seconds,
    }
