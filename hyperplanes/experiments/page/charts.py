"""Line charts for the page: SVG by matplotlib, readable in light and dark mode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hyperplanes.experiments.page.pictures import inline
from hyperplanes.utilities.images.plots import draw_lines, encode_figure, new_figure, set_counts

__all__ = ["line_chart"]

INK = "#8a857c"  # colour of axes and text, between the background colours of light and dark mode


def line_chart(
    series: Mapping[str, Sequence[tuple[float, float]]],
    vertical: str,
    horizontal: str = "steps",
    *,
    logarithmic: bool = False,
    counts: bool = False,
) -> str:
    """A chart of several lines as a data URI.

    Args:
        series: points (step, value) by name; lines without points are left out.
        vertical: the name of the vertical axis.
        horizontal: the name of the horizontal axis.
        logarithmic: whether the vertical axis is logarithmic.
        counts: whether the horizontal axis is logarithmic from 1 on, with a tick and a dot at every point; for a few
            increasing numbers that begin at 0.

    Returns:
        The data URI; empty if there are no points.
    """
    shown = {name: points for name, points in series.items() if points}
    if not shown:
        return ""
    figure = new_figure(6.0, 3.4)
    figure.patch.set_alpha(0)
    axes = figure.subplots()
    axes.patch.set_alpha(0)
    draw_lines(axes, shown, marks=counts)
    if counts:
        set_counts(axes, {x for points in shown.values() for x, _ in points})
    axes.set(xlabel=horizontal, ylabel=vertical, yscale="log" if logarithmic else "linear")
    axes.tick_params(colors=INK, which="both")
    axes.legend(labelcolor=INK, frameon=False, fontsize=8)
    for part in (axes.xaxis.label, axes.yaxis.label):
        part.set_color(INK)
    axes.spines[:].set_color(INK)
    return inline(encode_figure(figure, "svg"), "svg+xml")
