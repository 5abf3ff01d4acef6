"""Refines poses before a verb adapts to the views, and keeps them if they are better."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from hyperplanes.commands.output.writing import keep_if_possible
from hyperplanes.utilities.messages.formatting import format_duration

if TYPE_CHECKING:
    from torch import Tensor

    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.commands.output.console import Console
    from hyperplanes.views import Task, Views

__all__ = ["check_support", "refine_task"]

COMPARED_SIZE = 128  # pixels along the longer side of the support views when poses are compared
LEAST_GAIN = 0.5  # dB: four held-out views cannot measure less, and refining makes correct poses slightly worse


def refine_task(source: HyperPlanes, task: Task, console: Console, *, all_views: bool = False) -> Task:
    """The task with refined poses, or unchanged if these do not raise the PSNR of held-out support views enough.

    The poses of support and query views are refined together. Only support views decide which poses are used. The
    result is kept on the disk (`disk_cache`), so that another command on the same views does not compute it again.

    Args:
        source: the model that will adapt.
        task: the support and the query views.
        console: prints the result.
        all_views: whether support and query views are the same.

    Returns:
        The task; a ValueError if there are too few views, in all or as support.
    """
    from hyperplanes.commands.inputs.disk_cache import keep_tensors, kept_file, recall_tensors
    from hyperplanes.evaluation.suitability import HELD_OUT_SIZE
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.views import Task, join_views

    check_support(task)
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
    figures = f"held-out support views have {after:.2f} dB with the refined poses, {before:.2f} with the given ones"
    figures += f" ({HELD_OUT_SIZE} pixels); {how}"
    if after < before + LEAST_GAIN:
        console.say(f"poses: as given, because refined poses are not better by {LEAST_GAIN:g} dB: {figures}")
        return task
    turned = found["turned"]
    console.say(
        f"poses: refined, turned by {float(turned.median()):.2f} degrees (median), {float(turned.max()):.2f} at most: "
        f"{figures}"
    )
    views = views.to("cpu", found["extrinsics"].dtype)
    views = replace(views, cameras=camera.with_poses(views.cameras, found["extrinsics"]))
    return Task(views[:count], views if all_views else views[count:], task.name)


def check_support(task: Task) -> None:
    """Require enough support views to compare refined poses with the given ones.

    Raises:
        ValueError: fewer.
    """
    from hyperplanes.evaluation.suitability import FEWEST_VIEWS

    if len(task.support) < FEWEST_VIEWS:
        raise ValueError(
            f"--refine-poses: expected at least {FEWEST_VIEWS} support views to compare refined poses with the given "
            f"ones, got {len(task.support)}; add views, or --all-views"
        )


def _refined(source: HyperPlanes, views: Views, count: int, console: Console) -> dict[str, Tensor]:
    """The tensors of a refinement that are kept.

    They are "extrinsics" (view, 4, 4); "turned", the degrees by which each camera rotated about the centre of the
    scene; and "psnr" in dB, of held-out views among the first `count`, with the given and with the refined poses.
    """
    import torch

    from hyperplanes.capture.pose_refinement import refine_poses
    from hyperplanes.evaluation.suitability import held_out_psnr
    from hyperplanes.geometry import cameras as camera

    with console.bar("refining poses") as bar:
        found = refine_poses(views, on_step=lambda done, total: bar.show(done, total, "steps"))
    values = []
    for each in (views, found.views):
        compared = held_out_psnr(source, each[:count].resized(COMPARED_SIZE).to(source.rig.device))
        assert compared is not None
        values.append(compared[0])
    return {
        "extrinsics": camera.camera_from_world(found.views.cameras),
        "turned": found.turned,
        "psnr": torch.tensor(values),
    }
