"""What can be seen of a training: its curve as CSV, held-out views beside the truth, and TensorBoard."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hyperplanes.export.images import to_pixels
from hyperplanes.utilities.files import write_whole
from hyperplanes.utilities.metrics import ssim

__all__ = ["Samples", "TensorBoard", "write_curve"]


@dataclass(frozen=True)
class Samples:
    """Views of held-out objects.

    Attributes:
        pictures: (view, 3, height, width) as the model renders them, an object each.
        truth: as they are.
    """

    pictures: Sequence[Tensor]
    truth: Sequence[Tensor]

    @property
    def pairs(self) -> list[tuple[Tensor, Tensor]]:
        """The pictures and the truth of each object."""
        return list(zip(self.pictures, self.truth, strict=True))

    @property
    def ssim(self) -> float | None:
        """Mean structural similarity; None of pictures that are smaller than its window."""
        if min(side for truth in self.truth for side in truth.shape[-2:]) < 11:
            return None
        return float(torch.cat([ssim(seen.clamp(0, 1), truth) for seen, truth in self.pairs]).mean())

    def sheet(self) -> npt.NDArray[np.uint8]:
        """A picture (row, column, 3): a view a row, the prediction left of the truth (objects of the first's size)."""
        first = self.truth[0].shape[-2:]
        rows = [to_pixels(torch.cat(pair, -1)) for pair in self.pairs if pair[1].shape[-2:] == first]
        return np.concatenate([row for rows_of_one in rows for row in rows_of_one])


def write_curve(path: Path, curve: Sequence[Mapping[str, float]]) -> None:
    """Write the reports of a training as CSV: a row a report, a column a quantity, empty where it was not measured."""
    columns = list(dict.fromkeys(name for row in curve for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(curve)
    write_whole(path, text.getvalue().encode())


class TensorBoard:
    """Event files for TensorBoard: the quantities of the curve, and the held-out views.

    Args:
        folder: for the event files.
        step: steps done before; what an interrupted training wrote after them is not shown.

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
        """One report.

        Args:
            row: of the curve, with its step.
            samples: views to show.
        """
        step = int(row["step"])
        for name, value in row.items():
            if name != "step":
                self._writer.add_scalar(name, value, step)
        if samples is not None:
            self._writer.add_image("held-out views beside the truth", samples.sheet(), step, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()
