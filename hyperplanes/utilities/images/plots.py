"""Charts by matplotlib, drawn without a display: lines, bars, boxplots, and grids of pictures."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperplanes.utilities.files.writing import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "draw_bars",
    "draw_boxes",
    "draw_grid",
    "draw_lines",
    "encode_figure",
    "figure_kind",
    "new_figure",
    "save_figure",
    "set_counts",
]

COLOURS = ("#b4450e", "#2f6f8f", "#6b7f2a", "#7a4f9a", "#c08a1e", "#4a4a4a", "#b03a6a", "#2a8f7a")

Points = Sequence[tuple[float, float]]


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, its size in inches, that needs no display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure atomically, in the format of `figure_kind`. The same figure gives the same bytes."""
    write_whole(path, encode_figure(figure, figure_kind(path)))


def figure_kind(path: Path) -> str:
    """The format of a figure by its file name, such as "svg".

    Raises:
        ValueError: an ending that matplotlib does not know.
    """
    kind = path.suffix.removeprefix(".").lower()
    known = sorted(new_figure(1, 1).canvas.get_supported_filetypes())
    if kind not in known:
        raise ValueError(f"{path}: expected a name that ends in one of {', '.join(known)}, got {path.name!r}")
    return kind


def encode_figure(figure: Figure, kind: str) -> bytes:
    """A figure as a file in a format such as "svg", text kept as text; the same figure gives the same bytes."""
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "hyperplanes", "svg.fonttype": "none"}):
        figure.savefig(buffer, format=kind, dpi=110, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()


def set_counts(axes: Axes, counts: Iterable[float]) -> None:
    """A horizontal axis with a tick for each of increasing numbers: logarithmic from 1 on, linear from 0 to 1."""
    from matplotlib.ticker import NullLocator

    axes.set_xscale("symlog", linthresh=1)
    places = sorted(counts)
    axes.set_xticks(places, [f"{count:,.0f}" for count in places])
    axes.xaxis.set_minor_locator(NullLocator())


def draw_lines(
    axes: Axes,
    series: Mapping[str, Points],
    *,
    deviations: Mapping[str, Sequence[float]] | None = None,
    marks: bool = False,
) -> None:
    """A line for each series, named in a legend, optionally with a deviation band; empty ones are left out."""
    for (name, points), colour in zip(series.items(), _colours(len(series)), strict=True):
        if not points:
            continue
        x, y = np.array(points, dtype=np.float64).T
        axes.plot(x, y, "o-" if marks or len(x) < 3 else "-", ms=4, color=colour, label=name)
        if deviations and name in deviations:
            spread = np.array(deviations[name])
            axes.fill_between(x, y - spread, y + spread, color=colour, alpha=0.18, linewidth=0)
    if axes.get_lines():
        axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def draw_bars(
    axes: Axes, groups: Sequence[str], series: Mapping[str, tuple[Sequence[float], Sequence[float] | None]]
) -> None:
    """Bars side by side in groups, with error bars where a series has deviations; NaN leaves a gap."""
    width = 0.8 / max(1, len(series))
    for index, ((name, (values, spread)), colour) in enumerate(zip(series.items(), _colours(len(series)), strict=True)):
        places = np.arange(len(groups)) + width * (index - (len(series) - 1) / 2)
        axes.bar(places, values, width * 0.95, yerr=spread, color=colour, label=name, error_kw={"linewidth": 1})
    axes.set_xticks(range(len(groups)), groups)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))  # beside the axes, which the bars fill
    axes.grid(alpha=0.3, axis="y")
    axes.set_axisbelow(True)


def draw_boxes(axes: Axes, samples: Mapping[str, Sequence[float]]) -> None:
    """A box for each sample: median, quartiles, whiskers up to 1.5 times the box, and the values as dots."""
    axes.boxplot(list(samples.values()), tick_labels=list(samples), showfliers=False, medianprops={"color": COLOURS[0]})
    for place, values in enumerate(samples.values(), 1):
        spread = np.linspace(-0.12, 0.12, len(values)) if len(values) > 1 else np.zeros(1)
        axes.plot(place + spread, values, "o", ms=3, color=COLOURS[1], alpha=0.6)
    axes.grid(alpha=0.3, axis="y")


def draw_grid(rows: Sequence[Sequence[npt.NDArray[np.uint8]]], columns: Sequence[str], labels: Sequence[str]) -> Figure:
    """Pictures in rows under headings, without interpolation.

    Args:
        rows: pictures (height, width, 3), one for each column.
        columns: headings.
        labels: of the rows.

    Returns:
        A figure.
    """
    figure = new_figure(1.6 * len(columns) + 0.4, 1.6 * len(rows) + 0.4)
    places = np.atleast_2d(figure.subplots(len(rows), len(columns), squeeze=False))
    for line, pictures, label in zip(places, rows, labels, strict=True):
        for axes, picture in zip(line, pictures, strict=True):
            axes.imshow(picture, interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
        line[0].set_ylabel(label, fontsize=7)
    for axes, heading in zip(places[0], columns, strict=True):
        axes.set_title(heading, fontsize=8)
    return figure


def _colours(count: int) -> list[str]:
    return [COLOURS[index % len(COLOURS)] for index in range(count)]
