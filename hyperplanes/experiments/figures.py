"""The figures of an experiment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hyperplanes.experiments.engine import Curve, Outcome, Runner
from hyperplanes.experiments.report import value
from hyperplanes.utilities.images.plots import draw_bars, draw_boxes, draw_grid, draw_lines, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["curves_of", "figure_of", "pictures_of"]

AXIS_LABELS = {"psnr": "PSNR (dB)", "ssim": "SSIM", "image_seconds": "seconds a view"}


def figure_of(outcome: Outcome) -> Figure:
    """The figure of the experiment, of the kind that it states: bars, curves, boxes or PSNR over steps."""
    draw = {"bars": _bars, "curves": _curves, "boxes": _boxes, "steps": _steps}[outcome.experiment.figure]
    return _titled(draw(outcome), outcome)


def _titled(figure: Figure, outcome: Outcome) -> Figure:
    figure.suptitle(f"{outcome.experiment.title} ({outcome.scale.name}, seeds: {outcome.seeds})", fontsize=10)
    return figure


def _bars(outcome: Outcome) -> Figure:
    """Bars grouped by row: the results in the upper half, the paper's numbers in the lower half."""
    experiment, published = outcome.experiment, outcome.experiment.published
    cells = {(cell.row, cell.column): cell for cell in experiment.cells}
    figure = new_figure(max(6.0, 1.3 * len(experiment.rows) + 2), 6.5 if published else 3.5)
    parts = np.atleast_1d(figure.subplots(2 if published else 1, 1, sharex=True))
    ours = {}
    for column in experiment.columns:
        found = [
            value(outcome.scores[row, column], cells[row, column].quantity)
            if (row, column) in cells
            else (math.nan, None)
            for row in experiment.rows
        ]
        spread = None if any(each is None for _, each in found) else [float(each or 0.0) for _, each in found]
        ours[column] = ([number for number, _ in found], spread)
    draw_bars(parts[0], experiment.rows, ours)
    parts[0].set(ylabel=AXIS_LABELS[experiment.cells[0].quantity], title="here")
    if published is not None:
        theirs = {
            column: ([experiment.published_value(row, column) or math.nan for row in experiment.rows], None)
            for column in experiment.columns
        }
        draw_bars(parts[1], experiment.rows, theirs)
        parts[1].set(ylabel=AXIS_LABELS[experiment.cells[0].quantity], title=f"paper, {published.label}")
        parts[1].get_legend().remove()
    many = len(experiment.rows)
    parts[-1].tick_params(axis="x", labelrotation=60 if many > 9 else 20 if many > 4 else 0)
    return figure


def curves_of(outcome: Outcome) -> Figure | None:
    """PSNR, SSIM and loss during training, for experiments with a figure of boxes, as in the paper; otherwise None."""
    return _titled(_curves(outcome), outcome) if outcome.experiment.figure == "boxes" else None


def pictures_of(runner: Runner, outcome: Outcome) -> Figure | None:
    """A view of the first object of each row in `pictures`, by every method, beside the truth; None without any."""
    experiment = outcome.experiment
    if not experiment.pictures:
        return None
    lines, cells = [], {(cell.row, cell.column): cell for cell in experiment.cells}
    for row in experiment.pictures:
        shown = [runner.picture(experiment, cells[row, column]) for column in experiment.columns]
        lines.append([shown[0][0], *(picture for _, picture in shown)])
    columns = ["truth", *(column.replace(", ", ",\n") for column in experiment.columns)]
    pixels = [[(255 * each).round().byte().cpu().permute(1, 2, 0).numpy() for each in line] for line in lines]
    return draw_grid(pixels, columns, experiment.pictures)


def _curves(outcome: Outcome) -> Figure:
    """PSNR and SSIM of held-out objects, and the loss: means over the seeds with bands of their standard deviation."""
    figure = new_figure(14.0, 4.0)
    entries = {"psnr": "held-out PSNR (dB)", "ssim": "held-out SSIM", "loss": "loss"}
    for axes, (entry, label) in zip(figure.subplots(1, 3), entries.items(), strict=True):
        series, spread = {}, {}
        for name, curves in outcome.curves.items():
            series[name], spread[name] = _over_seeds(curves, entry)
        draw_lines(axes, series, deviations=spread)
        axes.set(xlabel="steps", ylabel=label)
        if entry == "loss":
            axes.set_yscale("log")
    return figure


def _over_seeds(curves: Sequence[Curve], entry: str) -> tuple[list[tuple[float, float]], list[float]]:
    found: dict[float, list[float]] = {}
    for curve in curves:
        for point in curve:
            if entry in point:
                found.setdefault(point["step"], []).append(point[entry])
    points = sorted(found.items())
    deviations = [float(np.std(values, ddof=min(1, len(values) - 1))) for _, values in points]
    return [(step, float(np.mean(values))) for step, values in points], deviations


def _boxes(outcome: Outcome) -> Figure:
    """PSNR of all objects and seeds on the left, means of the seeds on the right, with one box per row."""
    figure = new_figure(9.0, 4.0)
    column = outcome.experiment.columns[0]
    scores = {row: outcome.scores[row, column] for row in outcome.experiment.rows}
    runs = {row: score.seeds or (score,) for row, score in scores.items()}
    left, right = figure.subplots(1, 2)
    draw_boxes(left, {row: [each.psnr for run in found for each in run.objects] for row, found in runs.items()})
    draw_boxes(right, {row: [run.mean("psnr") for run in found] for row, found in runs.items()})
    left.set(title="objects", ylabel="PSNR (dB)", xlabel=outcome.experiment.title)
    right.set(title="means of seeds", xlabel=outcome.experiment.title)
    return figure


def _steps(outcome: Outcome) -> Figure:
    """PSNR over the number of steps; a row with a single number of steps is a horizontal line."""
    experiment = outcome.experiment
    figure = new_figure(7.0, 4.0)
    axes = figure.subplots()
    places = {row: [c for c in experiment.cells if c.row == row] for row in experiment.rows}
    last = max(float(cell.column) for cell in experiment.cells)
    series = {}
    for row, cells in places.items():
        points = [(float(cell.column), outcome.scores[row, cell.column].mean("psnr")) for cell in cells]
        series[row] = [(1.0, points[0][1]), (last, points[0][1])] if len(points) == 1 else points
    draw_lines(axes, series, marks=True)
    axes.set(xscale="log", xlabel="gradient steps on the support views", ylabel="PSNR (dB)")
    return figure
