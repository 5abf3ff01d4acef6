"""A figure of the lookup benchmark: bars for the standard setting, lines for the sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.parts.lookup_ways import STANDARD
from benchmarks.parts.reporting import Row
from hyperplanes.utilities.images.plots import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot"]

LABELS = {
    "kornia_loop": ("Kornia, camera by camera", "#9aa0a6"),
    "kornia_batched": ("Kornia, all cameras at once", "#5f6368"),
    "torch": ("ours, plain PyTorch", "#7baaf7"),
    "cpu": ("ours, CPU kernel", "#1a73e8"),
    "cpu_packed": ("ours, CPU kernel, 32 bits a pixel", "#0b3d91"),
    "triton": ("ours, GPU kernel", "#188038"),
}
AXES = {"planes": "planes", "points": "points", "resolution": "pixels along a side of each plane"}


def plot(rows: list[Row], path: Path, title: str) -> None:
    """Plot the standard setting as bars and the sweeps as lines, in one figure.

    Args:
        rows: the rows of the benchmark.
        path: the file to write.
        title: of the figure; names the machine.
    """
    figure = new_figure(13, 8)
    figure.suptitle(title, fontsize=11)
    grid = figure.add_gridspec(2, 3, height_ratios=[1.15, 1])
    _bars(figure.add_subplot(grid[0, :]), [row for row in rows if "sweep" not in row])
    shared = None
    for index, axis in enumerate(AXES):
        shared = figure.add_subplot(grid[1, index], sharey=shared)
        _lines(shared, axis, [row for row in rows if row.get("sweep") == axis])
        if index == 0:
            shared.set_ylabel("milliseconds, both, forward")
    save_figure(figure, path)


def _bars(axes: Axes, rows: list[Row]) -> None:
    """Plot the throughput of each implementation, grouped by the part of the lookup."""
    groups = [(part, gradient) for gradient in (False, True) for part in ("projection", "sampling", "both")]
    for index, (name, (label, colour)) in enumerate(LABELS.items()):
        found = {(row["part"], row["gradient"]): row for row in rows if row["way"] == name}
        places = [place + 0.15 * (index - 2) for place, group in enumerate(groups) if group in found]
        values = [float(found[group]["million_lookups_per_second"]) for group in groups if group in found]
        if values:
            bars = axes.bar(places, values, 0.14, color=colour, label=label)
            axes.bar_label(bars, fmt="{:.3g}", fontsize=7)
    words = {"projection": "projection alone", "sampling": "sampling alone", "both": "projection and sampling"}
    labels = [words[part] + ("\nforward and gradient" if gradient else "\nforward") for part, gradient in groups]
    axes.set_xticks(range(len(groups)), labels)
    planes, points, size = STANDARD
    axes.set_title(f"{planes} planes of {size} x {size} pixels, {points:,} points")
    axes.set(ylabel="million lookups a second (log)", yscale="log")
    axes.legend(ncols=len(LABELS), fontsize=8, loc="upper center")
    axes.margins(y=0.2)


def _lines(axes: Axes, axis: str, rows: list[Row]) -> None:
    """Plot the time of each implementation over one size; the ticks are the measured sizes, written in full."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for name, (_, colour) in LABELS.items():
        found = [row for row in rows if row["way"] == name]
        times = [1e3 * float(row["seconds"]) for row in found]
        axes.plot([float(row[axis]) for row in found], times, "o-", ms=3, color=colour)
    ticks = sorted({int(row[axis]) for row in rows})
    axes.set(xscale="log", yscale="log", xlabel=AXES[axis])
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="both")
