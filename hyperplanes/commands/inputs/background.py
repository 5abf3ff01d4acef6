"""Cuts the object out of the background of views without masks, before a verb adapts to them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from hyperplanes.commands.output.writing import keep_if_possible
from hyperplanes.utilities.messages.formatting import format_duration

if TYPE_CHECKING:
    from hyperplanes.commands.output.console import Console
    from hyperplanes.views import Task

__all__ = ["cut_out_task"]


def cut_out_task(task: Task, console: Console, *, all_views: bool = False) -> Task:
    """The task with masks and images over white, by a background model that is fitted to the support views.

    Views that already have masks are returned unchanged.

    Args:
        task: the support and the query views.
        console: prints what was found.
        all_views: whether support and query views are the same.

    Raises:
        ValueError: too few views, or no object that differs from the background.
    """
    from hyperplanes.capture.masks.background import Separated, separate_background
    from hyperplanes.commands.inputs.disk_cache import keep_tensors, kept_file, recall_tensors
    from hyperplanes.views import Task

    shown, started = task.support, time.perf_counter()
    if shown.masks is not None:
        console.say("background: not learned, because the views have masks")
        return task
    file = kept_file("background", shown)
    kept = recall_tensors(file, ("inner", "outer"))
    if kept is not None:
        found, how = Separated(kept["inner"], kept["outer"], shown.bounds), f"kept in {file}"
    else:
        with console.bar("learning the background") as bar:
            found = separate_background(shown, on_step=lambda done, total: bar.show(done, total, "steps"))
        grids = {"inner": found.inner, "outer": found.outer}
        keep_if_possible(file, lambda: keep_tensors(file, grids), console)
        how = ""
    support = found.cut_out(shown)
    query = support if all_views else found.cut_out(task.query)
    assert support.masks is not None
    share = float(support.masks.mean())
    if share < LEAST_SHARE:
        raise ValueError(
            f"--learn-background: expected an object within the bounds of {task.name}, found none "
            f"({share:.1%} of the pictures); give masks, or photographs from more sides"
        )
    how = how or format_duration(time.perf_counter() - started)
    console.say(f"background: learned; the object covers {share:.0%} of the pictures; {how}")
    return Task(support, query, task.name)


LEAST_SHARE = 0.002
"""Least share of the pixels that an object covers; with less, no object was found."""
