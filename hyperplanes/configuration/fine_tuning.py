"""How a field is fine-tuned on the support views of one object."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeAlias

from hyperplanes.utilities.arguments import checked_fields

__all__ = ["AVERAGE", "CELLS", "FINE_VIEWS", "FRESH", "MANY_VIEWS", "RATES", "FineTuning", "Steps"]

Steps: TypeAlias = int | Literal["auto"]

RATES: dict[str, tuple[Literal["adam", "muon"], float, float]] = {
    "weights": ("muon", 2e-3, 0.04),
    "hypernetwork": ("adam", 3e-4, 0.0),
}
"""What is optimised: by which optimiser, the learning rate of Adam, that of Muon. Chosen by measurement, see
docs/adaptation.md."""


FRESH = 0.5
"""Share of random weights that fine-tuning a field with a grid of features begins with; docs/small-training.md."""

AVERAGE = 1.5
"""Over the number of support views, of which there are few: the share of the field before the steps in pictures after
them; docs/adaptation.md."""

CELLS, FINE_VIEWS = 64, 20
"""Cells an axis of the grid of features that fine-tuning optimises with so many support views or more; hypernetworks
write half as many (docs/adaptation.md). Of so many views half as many learned steps are taken (docs/image-based.md)."""

MANY_VIEWS = 10
"""Support views of a field of any number of them from which on fine-tuning begins with weights that are partly random,
draws rays by contrast, and shows means with the visual hull; with fewer each of the three costs as often as it brings
(docs/small-training.md, docs/adaptation.md, docs/image-based.md). From this many views on, pictures are corrected too
(`adaptation.residuals`)."""


@checked_fields
@dataclass(frozen=True)
class FineTuning:
    """How a field is fine-tuned.

    Attributes:
        trainable: what is optimised: "weights", theta + delta itself, or "hypernetwork", a copy of the hypernetwork
            while theta is frozen, as in the paper.
        rays: a step, drawn from all support views.
        optimiser: "muon", "adam" or "sgd"; the best for what is trainable, see RATES, where None.
        learning_rate: of Adam or of plain gradient descent at the first step; that of RATES where None, or of
            the field (`Target.fine_tuning_rates`).
        muon_learning_rate: of Muon at the first step; likewise.
        final_rate_factor: what the rates fall to, as a fraction; 1 keeps them.
        decay: along half a "cosine", or "exponential".
        betas: of Adam.
        max_steps: the most steps that "auto" may choose.
        holdout: every so many-th support view is held out of the planes and of the rays while "auto" chooses.
        mask_views: a field that takes any number of views is not shown those that the rays of a step come from, a share
            `1 / holdout` of them, as it could copy their colours; a single view cannot be masked.
        fresh: share of random weights in those that the steps begin with, where a hypernetwork writes a grid of
            features: trained weights interpolated with random ones learn more in the same steps (Ash & Adams 2020, "On
            warm-starting neural network training"). Where None, FRESH with MANY_VIEWS or more, else none.
        seed: of rays and samples, and of random weights.
        cells: an axis of the grid of features that the steps optimise, where the weights of a field with one are
            trained: those that they begin with are interpolated to so many. Fewer than it has change nothing. Where
            None, CELLS for a field that takes any number of views, with FINE_VIEWS or more of them, else 0.
        average: share, in pictures, of the field that the steps begin with, where a hypernetwork writes a grid of
            features, the weights are trained, and none of the first ones is random. Where None, AVERAGE over the
            number of views, at most a half, with fewer than MANY_VIEWS, else 0.
        draw: the pixels of rays: all with the same probability ("uniform"), or those more often around which colours
            differ ("contrast"), which count less in the loss by as much. Where None, "contrast" for the weights of a
            field that takes any number of views, with MANY_VIEWS or more of them, else "uniform", as in the paper.

    Raises:
        ValueError: an unknown name, no ray, a rate that is negative or not finite, or every view held out.
    """

    trainable: Literal["weights", "hypernetwork"] = "weights"
    rays: int = 1024
    optimiser: Literal["adam", "muon", "sgd"] | None = None
    learning_rate: float | None = None
    muon_learning_rate: float | None = None
    final_rate_factor: float = 0.1
    decay: Literal["cosine", "exponential"] = "cosine"
    betas: tuple[float, float] = (0.9, 0.99)
    max_steps: int = 300
    holdout: int = 6
    mask_views: bool = True
    fresh: float | None = None
    seed: int = 0
    draw: Literal["uniform", "contrast"] | None = None
    cells: Annotated[int, range(257)] | None = None
    average: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("rays", 1), ("max_steps", 1), ("holdout", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        for name in ("learning_rate", "muon_learning_rate", "final_rate_factor"):
            rate = getattr(self, name)
            if rate is not None and not 0 <= rate < math.inf:
                raise ValueError(f"{name}: expected a finite number of 0 or more, got {rate}")

        for name in ("fresh", "average"):
            share = getattr(self, name)
            if share is not None and not 0 <= share <= 1:
                raise ValueError(f"{name}: expected a share from 0 to 1, got {share}")

    def fresh_share(self, views: int) -> float:
        """How much of the first weights is random, with so many support views."""
        return (FRESH if views >= MANY_VIEWS else 0.0) if self.fresh is None else self.fresh

    def average_share(self, views: int) -> float:
        """The share, in pictures, of the field that the steps begin with, with so many support views."""
        if self.trainable != "weights" or self.fresh_share(views):
            return 0.0
        few = AVERAGE / max(3, views) if views < MANY_VIEWS else 0.0
        return few if self.average is None else self.average

    def for_views(self, views: int, any_number: bool) -> FineTuning:
        """The settings with what so many views have where they leave `fresh`, `draw`, `cells` or `average` open.

        Args:
            views: how many there are.
            any_number: whether the field takes any number of them.
        """
        many = any_number and views >= MANY_VIEWS and self.trainable == "weights"
        draw = self.draw or ("contrast" if many else "uniform")
        finer = CELLS if many and views >= FINE_VIEWS else 0
        cells = finer if self.cells is None else self.cells
        shares = {"fresh": self.fresh_share(views), "average": self.average_share(views)}
        return replace(self, draw=draw, cells=cells, **shares)

    def with_rates(self, rates: Mapping[str, float]) -> FineTuning:
        """The settings with these rates where they state none; `rates` are fields of the settings by name."""
        return replace(self, **{name: rate for name, rate in rates.items() if getattr(self, name) is None})

    def schedule(self, step: int, steps: int) -> float:
        """What the rates are multiplied with at a step, counted from 0."""
        if self.decay == "exponential":
            return self.final_rate_factor ** (step / max(1, steps))
        cosine = (1 + math.cos(math.pi * step / max(1, steps))) / 2
        return self.final_rate_factor + (1 - self.final_rate_factor) * cosine
