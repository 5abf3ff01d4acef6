"""The time of one view by the default protocol, as a function of pixels, samples and planes."""

from __future__ import annotations

import statistics
from dataclasses import replace
from pathlib import Path

from kornia.geometry.camera import PinholeCamera

from benchmarks.parts.objects import held_out
from benchmarks.parts.reporting import Row
from benchmarks.parts.timing import timed
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.geometry import cameras as camera
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.images.plots import new_figure, save_figure

__all__ = ["growth", "plot_growth"]


def growth(model: HyperPlanes, quick: bool) -> list[Row]:
    """Seconds of one view for other numbers of pixels, of samples per ray and of planes than 128x128, 96 and 25.

    The networks for other numbers of planes are not trained. Their pictures are meaningless, but the cost of a sample
    is that of a trained network.

    Args:
        model: the model.
        quick: measure each setting once, not three times.
    """
    rows: list[Row] = []
    sizes, steps, counts = (32, 64, 128, 256, 512), (24, 48, 96, 192, 384), (1, 5, 10, 25, 50, 100)
    device = model.rig.device
    task = held_out(1, 128, device=device)[0]
    adapted, one = model.adapt(task.support), camera.select(task.query.cameras, [3])
    settings: list[tuple[str, int, AdaptedField, PinholeCamera, RayMarching]] = []
    settings += [("pixels", n, adapted, camera.resized(one, n, n), RayMarching()) for n in sizes]
    settings += [("steps", n, adapted, one, RayMarching(n)) for n in steps]
    for count in counts:
        config = ModelConfig(network=replace(model.config.network, planes=count), hypernetwork=None)
        untrained = HyperPlanes(config).to(device)
        support = held_out(1, 128, 2 * count, device)[0].support
        untrained.set_rig(support)
        settings.append(
            (
                "planes",
                count,
                replace(untrained.adapt(support), occupancy=adapted.refined_occupancy),
                one,
                RayMarching(),
            )
        )
    for axis, value, field, cameras, sampling in settings:
        _ = field.refined_occupancy
        field.render(cameras, sampling)
        taken = [timed(lambda f=field, c=cameras, s=sampling: f.render(c, s)) for _ in range(1 if quick else 3)]
        row: Row = {"name": f"growth with {axis}", "growth": axis, "value": value, "samples": taken[0][1].samples}
        rows.append(row | {"seconds": statistics.median(seconds for seconds, _ in taken)})
    return rows


def plot_growth(rows: list[Row], path: Path) -> None:
    """Plot the rows of `growth`, with a line for the time that is proportional to the number of samples."""
    figure = new_figure(11, 3.6)
    axes = figure.subplots(1, 3, sharey=True)
    labels = {"pixels": "pixels a side", "steps": "steps along the diameter", "planes": "ImagePlanes"}
    for where, (axis, label) in zip(axes, labels.items(), strict=True):
        found = [row for row in rows if row["growth"] == axis]
        values = [float(row["value"]) for row in found]
        seconds = [float(row["seconds"]) for row in found]
        samples = [float(row["samples"]) for row in found]
        middle = len(found) // 2
        where.plot(values, seconds, "o-", ms=4, label="one view")
        explained = [seconds[middle] * each / samples[middle] for each in samples]
        where.plot(values, explained, "--", color="0.6", label="in proportion to the samples asked for")
        where.set(xscale="log", yscale="log", xlabel=label)
        where.set_xticks(values, [f"{value:.0f}" for value in values])
        where.set_xticks([], minor=True)
        where.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("seconds")
    axes[0].legend(fontsize=8)
    save_figure(figure, path)
