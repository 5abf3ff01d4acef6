"""How a field is fine-tuned on the support views of one object."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeAlias

from hyperplanes.utilities.messages.arguments import checked_fields

__all__ = ["AVERAGE", "CELLS", "FINE_VIEWS", "FRESH", "MANY_VIEWS", "RATES", "FineTuning", "Steps"]

Steps: TypeAlias = int | Literal["auto"]
"""A number of fine-tuning steps, or "auto" for the number that is best for held-out views."""

RATES: dict[str, tuple[Literal["adam", "muon"], float, float]] = {
    "weights": ("muon", 2e-3, 0.04),
    "hypernetwork": ("adam", 3e-4, 0.0),
}
"""Default optimiser and learning rates of Adam and of Muon, for each value of `trainable`; measured in
docs/adaptation.md."""


FRESH = 0.5
"""Share of random weights in the initial ones, for a field with a grid of features; docs/small-training.md."""

AVERAGE = 1.5
"""Divided by the number of support views, if these are few: the share of the field before the steps in pictures after
them; docs/adaptation.md."""

CELLS, FINE_VIEWS = 64, 20
"""Cells an axis of the grid of features in fine-tuning with FINE_VIEWS support views or more; hypernetworks write half
as many (docs/adaptation.md). With FINE_VIEWS or more, half as many learned steps are taken (docs/image-based.md)."""

MANY_VIEWS = 10
"""Support views from which on fine-tuning a field of any number of views begins with partly random weights, draws rays
by contrast, and averages pictures with the visual hull; with fewer, each of the three loses as often as it gains
(docs/small-training.md, docs/adaptation.md, docs/image-based.md)."""


@checked_fields
@dataclass(frozen=True)
class FineTuning:
    """How a field is fine-tuned.

    Attributes:
        trainable: what is optimised: "weights", theta + delta itself, or "hypernetwork", a copy of the hypernetwork
            while theta is frozen, as in the paper.
        rays: per step, drawn from all support views.
        optimiser: "muon", "adam" or "sgd"; with None, that of RATES.
        learning_rate: of Adam or plain gradient descent at the first step; with None, that of RATES, or of the field
            (`Target.fine_tuning_rates`).
        muon_learning_rate: the same for Muon.
        final_rate_factor: the rates fall to this fraction; 1 keeps them.
        decay: "cosine" (half a period) or "exponential".
        betas: of Adam.
        max_steps: the most steps that "auto" may choose.
        holdout: one in this many support views is held out while "auto" chooses.
        mask_views: whether a field that takes any number of views does not see those that the rays of a step come from,
            a share `1 / holdout` of them, since it could copy their colours; a single view cannot be masked.
        fresh: share of random weights in the initial ones, if a hypernetwork writes a grid of features: trained weights
            interpolated with random ones learn more in the same steps (Ash & Adams 2020, "On warm-starting neural
            network training"). With None, FRESH for MANY_VIEWS or more, otherwise 0.
        seed: of rays and samples, and of random weights.
        cells: an axis of the grid of features, if the weights of a field with one are trained: the initial grid is
            interpolated to this size. Smaller numbers than it has change nothing. With None, CELLS for a field that
            takes any number of views and FINE_VIEWS or more of them, otherwise 0.
        average: share, in pictures, of the field before the steps, if a hypernetwork writes a grid of features, the
            weights are trained, and the initial ones are not random in part. With None, AVERAGE over the number of
            views, at most a half, for fewer than MANY_VIEWS, otherwise 0.
        draw: how pixels of rays are drawn: with equal probability ("uniform"), or more often where colours differ
            around them ("contrast"), with a weight in the loss that compensates for that. With None, "contrast" for the
            weights of a field that takes any number of views and MANY_VIEWS or more of them, otherwise "uniform", as in
            the paper.

    Raises:
        ValueError: an unknown name, or a number out of range.
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
        """The share of random weights in the initial ones, for this number of support views."""
        return (FRESH if views >= MANY_VIEWS else 0.0) if self.fresh is None else self.fresh

    def average_share(self, views: int) -> float:
        """The share, in pictures, of the field before the steps, for this number of support views."""
        if self.trainable != "weights" or self.fresh_share(views):
            return 0.0
        few = AVERAGE / max(3, views) if views < MANY_VIEWS else 0.0
        return few if self.average is None else self.average

    def for_views(self, views: int, any_number: bool) -> FineTuning:
        """The settings with `fresh`, `draw`, `cells` and `average` resolved for a number of views.

        Args:
            views: number of support views.
            any_number: whether the field takes any number of them.
        """
        many = any_number and views >= MANY_VIEWS and self.trainable == "weights"
        draw = self.draw or ("contrast" if many else "uniform")
        finer = CELLS if many and views >= FINE_VIEWS else 0
        cells = finer if self.cells is None else self.cells
        shares = {"fresh": self.fresh_share(views), "average": self.average_share(views)}
        return replace(self, draw=draw, cells=cells, **shares)

    def with_rates(self, rates: Mapping[str, float]) -> FineTuning:
        """The settings with `rates`, by name of the attribute, where these are None."""
        return replace(self, **{name: rate for name, rate in rates.items() if getattr(self, name) is None})

    def schedule(self, step: int, steps: int) -> float:
        """The factor of the rates at a step, counted from 0."""
        if self.decay == "exponential":
            return self.final_rate_factor ** (step / max(1, steps))
        cosine = (1 + math.cos(math.pi * step / max(1, steps))) / 2
        return self.final_rate_factor + (1 - self.final_rate_factor) * cosine
