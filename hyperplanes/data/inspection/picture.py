"""What views cover, drawn: a map of the directions, how each view agrees with the others, and the worst of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from hyperplanes.data.inspection.scene import COVERAGE_ANGLE, WORST, SceneReport, angles_to
from hyperplanes.utilities.images.plots import encode_figure, new_figure
from hyperplanes.views import Views

__all__ = ["draw_coverage"]

GRID_DEGREES = 3  # degrees
MAX_COLOUR_ANGLE = 90.0  # degrees from the nearest view at which the scale of colours ends


def draw_coverage(report: SceneReport, views: Views) -> bytes:
    """PNG of what a scene's views cover.

    Above, a map of all directions seen from the object, azimuth across and elevation up, coloured by the angle to the
    nearest view; the views are dots, those with faults red. Below, the worst views, with what is said of each.
    """
    figure: Any = new_figure(11, 7.5)
    above, below = figure.subfigures(2, 1, height_ratios=(1.3, 1))
    _draw_map(above.subplots(), report)
    below.suptitle("The least good views; none stands out" if report.is_sound else "The worst views", fontsize=11)
    shown = [report.views.index(view) for view in report.worst]
    for axes, index in zip(
        np.atleast_1d(below.subplots(1, max(WORST, len(shown)))), [*shown, *[None] * WORST], strict=False
    ):
        axes.axis("off")
        if index is None:
            continue
        axes.imshow(views.images[index].permute(1, 2, 0).clamp(0, 1).numpy())
        one = report.views[index]
        fit = "" if one.agreement is None else f"mask {one.agreement:.0%}"
        axes.set_title("\n".join([one.name, *(_wrapped(one.faults) or [fit])]), fontsize=7)
    return encode_figure(figure, "png")


def _draw_map(axes: Any, report: SceneReport) -> None:
    azimuth, elevation = (
        np.radians(np.arange(0, 360 + GRID_DEGREES, GRID_DEGREES)),
        np.radians(np.arange(-90, 90 + GRID_DEGREES, GRID_DEGREES)),
    )
    across, up = np.meshgrid(azimuth, elevation)
    flat = torch.from_numpy(_unit(across.ravel(), up.ravel()))
    stand = np.array([view.direction for view in report.views])
    angles = angles_to(torch.from_numpy(_unit(*np.radians(stand.T))), flat).reshape(across.shape).numpy()
    image = axes.pcolormesh(
        np.degrees(azimuth), np.degrees(elevation), angles, cmap="viridis_r", vmin=0, vmax=MAX_COLOUR_ANGLE
    )
    axes.contour(np.degrees(azimuth), np.degrees(elevation), angles, [COVERAGE_ANGLE], colors="white", linewidths=1)
    faulty = np.array([bool(view.faults) for view in report.views])
    axes.scatter(*stand[~faulty].T, s=18, c="white", edgecolors="black", linewidths=0.7)
    axes.scatter(*stand[faulty].T, s=28, c="tab:red", edgecolors="black", linewidths=0.7)
    for view in report.worst if not report.is_sound else ():
        axes.annotate(view.name, view.direction, textcoords="offset points", xytext=(5, 4), fontsize=7)
    axes.set(xlabel="azimuth in degrees", ylabel="elevation in degrees", xlim=(0, 360), ylim=(-90, 90))
    axes.set_title(
        f"{report.covered:.0%} of all directions lie within {COVERAGE_ANGLE:.0f} degrees of a view "
        "(inside the white line)",
        fontsize=11,
    )
    axes.figure.colorbar(image, ax=axes, label="degrees to the nearest view")


def _unit(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Directions in a world with y up."""
    return np.stack([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], -1)


def _wrapped(faults: tuple[str, ...]) -> list[str]:
    import textwrap

    return [line for fault in faults for line in textwrap.wrap(fault, 34)]
