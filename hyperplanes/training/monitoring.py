"""The reports of a training: its curve, gradient norms, speed and held-out views, also for TensorBoard."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hyperplanes.adaptation.diagnostics import Diagnostics
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.export.images import to_pixels
from hyperplanes.utilities.files.tables import csv_table
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.images.metrics import ssim

__all__ = ["Progress", "Samples", "Speed", "TensorBoard", "gradient_norms", "write_curve"]


@dataclass(frozen=True)
class Progress:
    """The progress of a training.

    Attributes:
        step: steps done.
        steps: steps to do in all.
        loss: mean squared error of the last step's rays, plus the losses of `volume_loss` and `empty_points`.
        rays_per_second: the speed since the last report.
        psnr: mean PSNR in dB of some views of held-out objects; None if this step had no validation.
        seconds_left: an estimate from the speed so far.
        diagnostics: diagnostics of the hypernetwork on those objects, if the step had a validation.
    """

    step: int
    steps: int
    loss: float
    rays_per_second: float
    psnr: float | None
    seconds_left: float
    diagnostics: Diagnostics | None = None


@dataclass(frozen=True)
class Samples:
    """Views of held-out objects.

    Attributes:
        pictures: for each object, its rendered views (view, 3, height, width).
        truth: the true images of the same views.
    """

    pictures: Sequence[Tensor]
    truth: Sequence[Tensor]

    @property
    def pairs(self) -> list[tuple[Tensor, Tensor]]:
        """The pictures and the truth of each object."""
        return list(zip(self.pictures, self.truth, strict=True))

    @property
    def ssim(self) -> float | None:
        """Mean structural similarity; None if pictures are smaller than its window of 11 pixels."""
        if min(side for truth in self.truth for side in truth.shape[-2:]) < 11:
            return None
        return float(torch.cat([ssim(seen.clamp(0, 1), truth) for seen, truth in self.pairs]).mean())

    def sheet(self) -> npt.NDArray[np.uint8]:
        """An image (row, column, 3) with one view per row, the prediction left of the truth.

        It has only objects whose views have the size of those of the first.
        """
        first = self.truth[0].shape[-2:]
        rows = [to_pixels(torch.cat(pair, -1)) for pair in self.pairs if pair[1].shape[-2:] == first]
        return np.concatenate([row for rows_of_one in rows for row in rows_of_one])


def write_curve(path: Path, curve: Sequence[Mapping[str, float]]) -> None:
    """Write the reports of a training as CSV, with one row per report; quantities that were not measured are empty.

    The columns are step, loss, and the other quantities in alphabetical order, so that a resumed training has the same
    order.
    """
    columns = ["step", "loss", *sorted({name for row in curve for name in row} - {"step", "loss"})]
    write_whole(path, csv_table(columns, [[row.get(name) for name in columns] for row in curve]).encode())


@torch.no_grad()
def gradient_norms(model: HyperPlanes) -> dict[str, float]:
    """Norms of the gradients of the last step, after clipping: of theta and, if there is one, of the hypernetwork."""
    found = {}
    for name, part in {"theta": model.networks, "hypernetwork": model.hypernetwork}.items():
        gradients = [] if part is None else [each.grad for each in part.parameters() if each.grad is not None]
        if gradients:
            found[f"gradient_{name}"] = float(torch.stack([each.norm() for each in gradients]).norm())
    return found


class Speed:
    """Measures the rays per second since the last report, and estimates the seconds for the remaining steps."""

    def __init__(self, step: int, steps: int, rays: int) -> None:
        self._first, self._steps, self._rays = step, steps, rays
        self._began = time.perf_counter()
        self._reported = (self._began, step)

    def rays_per_second(self, step: int) -> float:
        """The speed since the last report. Time between a report and the next step, as for validation, is excluded."""
        before, reported = self._reported
        return (step - reported) * self._rays / max(time.perf_counter() - before, 1e-9)

    def seconds_left(self, step: int) -> float:
        """An estimate from the speed so far, including validation. The time of the next report begins here."""
        now = time.perf_counter()
        self._reported = (now, step)
        return (now - self._began) / (step - self._first) * (self._steps - step)


class TensorBoard:
    """Writes event files for TensorBoard: the quantities of the curve, and the held-out views.

    Args:
        folder: the folder for the event files.
        step: steps done before. Events of later steps, from a training that was interrupted, are not shown.

    Raises:
        ValueError: the package tensorboard is not installed.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise ValueError(
                "tensorboard: expected the package tensorboard, found none; pip install 'hyperplanes[watch]'"
            ) from None
        self._writer = SummaryWriter(folder, purge_step=step + 1 if step else None)

    def add(self, row: Mapping[str, float], samples: Samples | None = None) -> None:
        """Write one report."""
        step = int(row["step"])
        for name, value in row.items():
            if name != "step":
                self._writer.add_scalar(name, value, step)
        if samples is not None:
            self._writer.add_image("held-out views beside the truth", samples.sheet(), step, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        """Write buffered events and close the files."""
        self._writer.close()
