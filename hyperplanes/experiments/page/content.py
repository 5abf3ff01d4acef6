"""What a report shows, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Exhibit", "QueryView", "Pixels", "Report", "Row"]

Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class QueryView:
    """One view that no method was shown.

    Attributes:
        truth: (height, width, 3).
        predictions: by method, of the same size.
    """

    truth: Pixels
    predictions: Mapping[str, Pixels]


@dataclass(frozen=True)
class Exhibit:
    """One held-out object.

    Attributes:
        name: of the object.
        support: (view, height, width, 3), what the methods were shown.
        read: which of them the hypernetwork reads.
        views: some query views.
        psnr: dB over all query views, by method.
        turntable: an animated WebP of the prediction, or nothing.
    """

    name: str
    support: Pixels
    read: Sequence[int]
    views: Sequence[QueryView]
    psnr: Mapping[str, float]
    turntable: bytes = b""

    @property
    def order(self) -> list[int]:
        """The support views as they are shown, those that the hypernetwork reads first."""
        return [*self.read, *(index for index in range(len(self.support)) if index not in self.read)]


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        method: its name.
        about: what it is, in a few words.
        psnr: dB, mean over objects.
        deviation: dB, standard deviation over objects.
        foreground: dB inside the true masks, mean over objects; None without masks.
        ssim: mean over objects.
        adapt: how long it took from images to a field, as text.
        render: how long a view took, as text.
    """

    method: str
    about: str
    psnr: float
    deviation: float
    foreground: float | None
    ssim: float
    adapt: str
    render: str


@dataclass(frozen=True)
class Report:
    """All that the page says.

    Attributes:
        title: its heading.
        lead: one sentence under it.
        figures: a few numbers worth reading first, each with what it is.
        method: the one that is shown first.
        exhibits: held-out objects.
        table: one row a method.
        curves: by method, training entries with "step", "loss" and at times "psnr"; without any, nothing is said of
            training and fine-tuning.
        tuning: by method, PSNR in dB after numbers of fine-tuning steps.
        diagnostics: what the updates of the hypernetwork have and have not in common, in words.
        facts: how it was made, label and value.
        commands: how to make it again, and what to try next.
    """

    title: str
    lead: str
    figures: Sequence[tuple[str, str]]
    method: str
    exhibits: Sequence[Exhibit]
    table: Sequence[Row]
    curves: Mapping[str, Sequence[Mapping[str, float]]]
    tuning: Mapping[str, Sequence[tuple[float, float]]]
    diagnostics: str
    facts: Sequence[tuple[str, str]]
    commands: Sequence[tuple[str, str]]
