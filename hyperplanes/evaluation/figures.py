"""Figures of the scores of several methods: boxes over objects, PSNR over fine-tuning steps, pictures side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.adaptation.base import Pictures
from hyperplanes.evaluation.scores import Score
from hyperplanes.export.images import to_pixels
from hyperplanes.utilities.images.plots import draw_boxes, draw_grid, draw_lines, new_figure, save_figure, set_counts
from hyperplanes.views import Task

__all__ = ["PictureGrid", "save_boxes", "save_curves"]


def save_boxes(scores: Sequence[Score], path: Path) -> None:
    """Draw the PSNR of the objects as one box per method.

    Args:
        scores: the scores of the methods.
        path: the file of the figure.
    """
    figure = new_figure(max(5.0, 1.4 * len(scores)), 4.0)
    axes = figure.subplots()
    draw_boxes(axes, {score.method: [each.psnr for each in score.objects] for score in scores})
    axes.set(ylabel="PSNR of an object (dB)")
    axes.tick_params(axis="x", labelrotation=20)
    save_figure(figure, path)


def save_curves(curves: Mapping[str, Sequence[tuple[float, float]]], steps: Sequence[int], path: Path) -> None:
    """Draw PSNR over fine-tuning steps for every method.

    Args:
        curves: pairs of steps and PSNR in dB, by method.
        steps: the ticks of the horizontal axis.
        path: the file of the figure.
    """
    figure = new_figure(6.0, 3.6)
    axes = figure.subplots()
    draw_lines(axes, curves, marks=True)
    set_counts(axes, steps)
    axes.set(xlabel="fine-tuning steps", ylabel="PSNR (dB)")
    save_figure(figure, path)


class PictureGrid:
    """Draws a query view of each of the first `rows` objects, by the first seed of every method, beside the truth."""

    rows = 6

    def __init__(self) -> None:
        self.seen: dict[str, dict[str, npt.NDArray[np.uint8]]] = {}

    def add(self, method: str, seed: int, task: Task, pictures: Pictures) -> None:
        """Keep a picture of an object if it is one of the first `rows` objects and the seed is 0.

        Args:
            method: the name of the method.
            seed: the seed.
            task: the object.
            pictures: the rendered query views.
        """
        if seed or (task.name not in self.seen and len(self.seen) >= self.rows):
            return
        view = len(task.query) // 4
        found = self.seen.setdefault(task.name, {"truth": to_pixels(task.query.images[view : view + 1])[0]})
        found[method] = to_pixels(pictures.images[view : view + 1])[0]

    def save(self, path: Path) -> None:
        """Draw the grid with the objects on which no method failed.

        If there is no such object, it has the methods that failed on no object.

        Args:
            path: the file of the figure (PNG, SVG or PDF).
        """
        columns = list(dict.fromkeys(name for row in self.seen.values() for name in row))
        whole = {name: row for name, row in self.seen.items() if len(row) == len(columns)}
        if not whole:
            whole, columns = self.seen, [name for name in columns if all(name in row for row in self.seen.values())]
        save_figure(draw_grid([[row[each] for each in columns] for row in whole.values()], columns, list(whole)), path)
