"""Poses refined before a verb adapts to the views, where that is worth it."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from hyperplanes.commands.writing import keep_if_possible
from hyperplanes.utilities.formatting import format_duration

if TYPE_CHECKING:
    from torch import Tensor

    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.commands.console import Console
    from hyperplanes.views import Task, Views

__all__ = ["refine_task"]

JUDGED = 128  # pixels along the longer side of the views that are shown to compare poses
LEAST_GAIN = 0.5  # decibels; four views say no more, and right poses become a little worse


def refine_task(source: HyperPlanes, task: Task, console: Console, *, all_views: bool = False) -> Task:
    """The views with refined poses, or as they are where a field of the refined ones shows left-out views no better.

    Support and query are refined together; only support views decide which poses are taken. What was found is kept
    (`adaptation.kept`), so that another command on the same views does not search again.

    Args:
        source: the model that will adapt.
        task: the views to show and those to ask for.
        console: where it is said.
        all_views: both are the same.

    Too few views are a ValueError.
    """
    from hyperplanes.adaptation.kept import keep_tensors, kept_file, recall_tensors
    from hyperplanes.evaluation.suitability import HELD_OUT_SIZE
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.views import Task, join_views

    count, started = len(task.support), time.perf_counter()
    views = task.support if all_views else join_views(task.support, task.query)
    file = kept_file("poses", views, source, count)
    found = recall_tensors(file, ("extrinsics", "turned", "psnr"))
    how = f"kept in {file}"
    if found is None:
        found = _refined(source, views, count, console)
        how = format_duration(time.perf_counter() - started)
        keep_if_possible(file, partial(keep_tensors, file, found), console)
    before, after = found["psnr"].tolist()
    figures = f"support views left out have {after:.2f} dB with them, {before:.2f} as given"
    figures += f" ({HELD_OUT_SIZE} pixels); {how}"
    if after < before + LEAST_GAIN:
        console.say(f"poses: as given, refined ones are not better by {LEAST_GAIN:g} dB: {figures}")
        return task
    turned = found["turned"]
    console.say(
        f"poses: refined, turned by {float(turned.median()):.2f} degrees (median), {float(turned.max()):.2f} at most: "
        f"{figures}"
    )
    views = views.to("cpu", found["extrinsics"].dtype)
    views = replace(views, cameras=camera.with_poses(views.cameras, found["extrinsics"]))
    return Task(views[:count], views if all_views else views[count:], task.name)


def _refined(source: HyperPlanes, views: Views, count: int, console: Console) -> dict[str, Tensor]:
    """What is kept of a refinement: poses, by how much they turned, and what the first `count` views say of them.

    The latter is the PSNR in decibels of those of them that are left out, with the given poses and with the refined.
    """
    import torch

    from hyperplanes.adaptation.pose_refinement import refine_poses
    from hyperplanes.evaluation.suitability import held_out_psnr
    from hyperplanes.geometry import cameras as camera

    with console.bar("refining poses") as bar:
        found = refine_poses(views, on_step=lambda done, total: bar.show(done, total, "steps"))
    judged = [
        held_out_psnr(source, each[:count].resized(JUDGED).to(source.rig.device)) for each in (views, found.views)
    ]
    values = torch.tensor([each[0] if each is not None else 0.0 for each in judged])
    return {"extrinsics": camera.camera_from_world(found.views.cameras), "turned": found.turned, "psnr": values}
