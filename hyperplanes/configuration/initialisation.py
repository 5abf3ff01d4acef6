"""Learned initialisations: weights for few gradient steps on one object (Tancik et al. 2021)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.utilities.messages.arguments import checked_fields

__all__ = ["LEARNED", "InitialisationConfig"]

LEARNED: dict[str, str] = {
    "mv_meta": "an initialisation learned by Reptile from all support views of every object",
    "sv_meta": "an initialisation learned by Reptile from a single view of every object",
    "maml": "an initialisation learned by MAML",
    "maml_first_order": "an initialisation learned by MAML without second derivatives",
    "mv_matched": "random weights trained to the outputs of mv_meta",
}
"""The initialisations that are trained, by the names of their methods."""


@checked_fields
@dataclass(frozen=True)
class InitialisationConfig:
    """How an initialisation is learned, and how a field is optimised from it.

    The defaults are those of Tancik et al. 2021 for ShapeNet: plain gradient descent with a rate of 0.5, 32 steps on an
    object in training, 2,000 steps of 64 rays on a new object. `TrainingConfig` has the rays of a training step (128
    there) and the rate of Adam for the initialisation (5e-5 there). MAML keeps the graph of all inner steps, so it
    takes few of them; Finn et al. 2017 take 5.

    Attributes:
        method: one of LEARNED.
        inner_steps: gradient steps on each object in training.
        inner_rate: of plain gradient descent, in training and on a new object.
        steps: gradient steps on a new object, if the name of the method has no number.
        test_rays: per step on a new object.
    """

    method: str = "mv_meta"
    inner_steps: Annotated[int, range(1, 16385)] = 32
    inner_rate: float = 0.5
    steps: Annotated[int, range(10**7)] = 2000
    test_rays: Annotated[int, range(1, 2**20 + 1)] = 64

    def __post_init__(self) -> None:
        if self.method not in LEARNED:
            raise ValueError(f"method: expected one of {', '.join(LEARNED)}, got {self.method!r}")
        if not 0 <= self.inner_rate < math.inf:
            raise ValueError(f"inner_rate: expected a finite number of 0 or more, got {self.inner_rate}")

    def descent(self, rays: int | None = None, given: FineTuning | None = None) -> FineTuning:
        """Settings of plain gradient descent at a constant rate, `inner_rate`, on rays of all pixels by default.

        Args:
            rays: per step; by default `test_rays`.
            given: settings that are kept, except `trainable`, `rays` and, with "sgd", `final_rate_factor`, which is 1.
        """
        given = given or FineTuning()
        optimiser = given.optimiser or "sgd"
        plain = optimiser == "sgd"
        return replace(
            given.with_rates({"learning_rate": self.inner_rate} if plain else {}),
            trainable="weights",
            rays=rays or self.test_rays,
            optimiser=optimiser,
            draw=given.draw or "uniform",
            final_rate_factor=1.0 if plain else given.final_rate_factor,
        )
