"""HyperPlanes-10 and HyperPlanes-100: the hypernetwork refined on the support views of each object."""

from __future__ import annotations

from dataclasses import dataclass

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.views import Views

__all__ = ["FineTuned"]


@dataclass(frozen=True)
class FineTuned:
    """A model that takes some steps on every object before it answers.

    Attributes:
        model: never changed.
        steps: of fine-tuning an object.
    """

    model: HyperPlanes
    steps: int

    def adapt(self, support: Views) -> AdaptedField:
        """The field after fine-tuning on the support views."""
        return self.model.fine_tune(support, self.steps)
