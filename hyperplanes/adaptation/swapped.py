"""Each object with the update of another: a control that shows whether the update depends on the object."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import torch

from hyperplanes.adaptation.alignment.canonical_frame import to_canonical_frame
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.correction.residuals import corrected_field
from hyperplanes.adaptation.correction.stacking import stacked_field
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.network import in_use
from hyperplanes.adaptation.optimisation.learned_steps import take_learned_steps
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.views import Views

__all__ = ["Swapped"]


class Swapped:
    """HyperPlanes with the update of the next object, and the planes and hull of the object itself.

    Args:
        model: with a hypernetwork.
        objects: the support views of all objects to adapt to, or of others; read once.

    Raises:
        ValueError: a model without a hypernetwork, or fewer than two objects.
    """

    @without_autocast
    def __init__(self, model: HyperPlanes, objects: Iterable[Views]) -> None:
        if model.hypernetwork is None:
            raise ValueError("swapped: expected a model with a hypernetwork, got one without")
        self.model = model
        self._updates: dict[str, Parameters] = {}
        with torch.no_grad(), in_use(model):
            for support in objects:
                placed = to_canonical_frame(model, support)
                self._updates[_digest(model, support)] = model.update(placed.context(model, carved=False))
        if len(self._updates) < 2:
            raise ValueError(f"swapped: expected at least 2 objects to swap updates of, got {len(self._updates)}")

    @without_autocast
    @torch.inference_mode(mode=False)  # learned steps read gradients
    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The field of theta plus the update of the next object, with everything else as for the object itself."""
        placed = to_canonical_frame(self.model, support)
        prepared = placed.context(self.model)
        known = list(self._updates)
        own = _digest(self.model, support)
        other = known[(known.index(own) + 1) % len(known) if own in self._updates else 0]
        weights = take_learned_steps(self.model, prepared, self.model.updated_by(self._updates[other]))
        made = placed.in_scene(stacked_field(self.model, prepared, weights))
        return corrected_field(self.model, made, support)


def _digest(model: HyperPlanes, support: Views) -> str:
    """A hash of the images in the precision of the model, the same for an object in any precision."""
    return hashlib.sha256(model.to_own(support).images.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
