"""The content of a report, as dataclasses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["Exhibit", "QueryView", "Pixels", "Report", "Row"]

Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class QueryView:
    """One query view, which was given to no method.

    Attributes:
        truth: the true image, (height, width, 3).
        predictions: the pictures by method, of the same size.
    """

    truth: Pixels
    predictions: Mapping[str, Pixels]


@dataclass(frozen=True)
class Exhibit:
    """One held-out object.

    Attributes:
        name: the name of the object.
        support: the support views, (view, height, width, 3).
        read: the indices of the support views that the hypernetwork reads.
        views: some query views.
        psnr: PSNR in dB over all query views, by method.
        turntable: an animated WebP file of the prediction, or empty.
    """

    name: str
    support: Pixels
    read: Sequence[int]
    views: Sequence[QueryView]
    psnr: Mapping[str, float]
    turntable: bytes = b""

    @property
    def order(self) -> list[int]:
        """The indices of the support views on the page: first those that the hypernetwork reads, then the others."""
        return [*self.read, *(index for index in range(len(self.support)) if index not in self.read)]


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        method: the name of the method.
        about: a short description of it.
        psnr: PSNR in dB, mean over objects.
        deviation: standard deviation of PSNR over objects, in dB; None for a single one.
        foreground: PSNR in dB inside the true masks, mean over objects; None without masks.
        ssim: SSIM, mean over objects.
        adapt: the time from images to a field, as text.
        render: the time to render a view, as text.
    """

    method: str
    about: str
    psnr: float
    deviation: float | None
    foreground: float | None
    ssim: float
    adapt: str
    render: str


@dataclass(frozen=True)
class Report:
    """The content of the page.

    Attributes:
        title: the heading.
        lead: the sentences below the heading.
        figures: the most important numbers as text, each with a description.
        method: the method that is selected at first.
        exhibits: held-out objects.
        table: one row per method.
        curves: by method, the rows of the curve of its training, with "step", "loss" and sometimes "psnr". If empty,
            the sections on training and fine-tuning are left out.
        tuning: by method, pairs of a number of fine-tuning steps and PSNR in dB.
        diagnostics: a description of how much the updates of the hypernetwork differ.
        facts: labels and values on how the page was made.
        commands: descriptions and commands, to reproduce the page and to try next.
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
