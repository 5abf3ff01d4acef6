"""Methods that take gradient steps on the support views of every object, from trained weights and from random ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.fine_tuning import FineTuning, Steps
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.views import Views

__all__ = ["SCRATCH_RATES", "FineTuned", "FromScratch"]

SCRATCH_RATES = {"learning_rate": 4e-3, "muon_learning_rate": 0.05}
"""Of Adam and of Muon from random weights: higher than those of fine-tuning, docs/adaptation.md."""


@dataclass(frozen=True)
class FineTuned:
    """A model that is fine-tuned on the support views of every object.

    Attributes:
        model: never changed.
        steps: of fine-tuning an object, or "auto".
        settings: of fine-tuning.
    """

    model: HyperPlanes
    steps: Steps
    settings: FineTuning = field(default_factory=FineTuning)

    def adapt(self, support: Views, on_step: Callable[[int], None] | None = None) -> AdaptedField:
        """The field after fine-tuning on the support views."""
        return self.model.fine_tune(support, self.steps, self.settings, on_step=on_step)


@dataclass(frozen=True)
class FromScratch:
    """The target network of a model, optimised on the support views of every object from random weights.

    The control of fine-tuning: the same field, planes, rays and number of steps, without what training has learned.

    Attributes:
        model: whose architecture and rig are used; its weights are not.
        steps: of optimising an object, or "auto".
        settings: of the optimisation; rates that it does not state are those of SCRATCH_RATES. Its seed is that of the
            random weights, too, and all weights are free.
    """

    model: HyperPlanes
    steps: Steps
    settings: FineTuning = field(default_factory=FineTuning)

    def adapt(self, support: Views, on_step: Callable[[int], None] | None = None) -> AdaptedField:
        """The field after so many steps from random weights."""
        fresh = HyperPlanes(replace(self.model.config, hypernetwork=None), seed=self.settings.seed)
        fresh.rig.copy_(self.model.rig)
        settings = replace(
            self.settings,
            free="weights",
            **{name: rate for name, rate in SCRATCH_RATES.items() if getattr(self.settings, name) is None},
        )
        return fresh.to(self.model.rig.device).fine_tune(support, self.steps, settings, on_step=on_step)
