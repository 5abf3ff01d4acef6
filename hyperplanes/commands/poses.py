"""Poses refined before a verb adapts to the views, where that is worth it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from hyperplanes.utilities.formatting import format_duration

if TYPE_CHECKING:
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.commands.console import Console
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.views import Task

__all__ = ["refine_task"]

JUDGED = 128  # pixels along the longer side of the pictures on which poses are compared
LEAST_GAIN = 0.5  # decibels; four views say no more, and right poses become a little worse


def refine_task(source: HyperPlanes | BakedScene, task: Task, console: Console, *, all_views: bool = False) -> Task:
    """The views with refined poses, or as they are where a field of the refined ones shows left-out views no better.

    Support and query are refined together; only support views decide which poses are kept.

    Args:
        source: the model that will adapt.
        task: the views to show and those to ask for.
        console: where it is said.
        all_views: both are the same.

    Raises:
        ValueError: a baked scene, which adapts to nothing, or too few views.
    """
    from hyperplanes.adaptation.pose_refinement import refine_poses
    from hyperplanes.evaluation.suitability import held_out_psnr
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.views import Task, join_views

    if isinstance(source, BakedScene):
        raise ValueError("--refine-poses: expected a model that adapts to the views, got a baked file")
    count, started = len(task.support), time.perf_counter()
    with console.bar("refining poses") as bar:
        found = refine_poses(
            task.support if all_views else join_views(task.support, task.query),
            on_step=lambda done, total: bar.show(done, total, "steps"),
        )
    support = found.views[:count]
    judged = [held_out_psnr(source, each.resized(JUDGED).to(source.rig.device)) for each in (task.support, support)]
    before, after = (each[0] if each is not None else 0.0 for each in judged)
    took = format_duration(time.perf_counter() - started)
    figures = f"support views left out have {after:.2f} dB with them, {before:.2f} as given (64 pixels); {took}"
    if after < before + LEAST_GAIN:
        console.say(f"poses: as given, refined ones are not better by {LEAST_GAIN:g} dB: {figures}")
        return task
    turned = found.turned
    console.say(
        f"poses: refined, turned by {float(turned.median()):.2f} degrees (median), {float(turned.max()):.2f} at most: "
        f"{figures}"
    )
    return Task(support, support if all_views else found.views[count:], task.name)
