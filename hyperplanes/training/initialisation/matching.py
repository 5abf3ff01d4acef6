"""Random weights matched to a learned initialisation: the same function with other weights (Tancik et al. 2021)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.functional import normalize

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.episodes import Batch
from hyperplanes.training.episodes.drawing import points_in
from hyperplanes.training.initialisation.base import InitialisationObjective
from hyperplanes.training.losses import thin_opacity

__all__ = ["Matching"]


class Matching(InitialisationObjective):
    """Trains random weights to reproduce the colours and opacities of a learned initialisation at random points.

    This is "Matched" of Tancik et al. 2021. The opacity is `thin_opacity`. Only the planes of the objects are used, and
    for a NeRF nothing but their bounds. The rig is that of the reference.

    Args:
        model: as in `InitialisationObjective`.
        config: as in `InitialisationObjective`; `rays` is the number of points.
        reference: the learned initialisation, of the same field.

    Raises:
        ValueError: a reference with another field, or by another method than mv_meta.
    """

    def __init__(self, model: HyperPlanes, config: TrainingConfig, reference: HyperPlanes) -> None:
        super().__init__(model, config)
        differing = reference.config.differences(replace(model.config, initialisation=reference.config.initialisation))
        if differing or reference.config.method != "mv_meta":
            what = f"other {', '.join(differing)}" if differing else f"a checkpoint of {reference.config.method}"
            raise ValueError(f"reference: expected mv_meta of the same field, which mv_matched is to match, got {what}")
        self.reference = reference.to(model.rig.device).eval().requires_grad_(False)
        model.rig.copy_(self.reference.rig)

    def gradients(self, batch: Batch) -> float:
        """Set the gradient of the squared differences of the outputs; returns their mean over the objects."""
        total, count = torch.zeros((), device=self.model.rig.device), len(batch.rendered)
        for draw in batch.rendered:
            prepared, generator = draw.episode.prepared, draw.generator
            # random points of the scene, seen from random directions
            bounds = prepared.occupancy.bounds
            points = points_in(bounds, self.config.rays, generator).to(total)
            directions = normalize(torch.randn(self.config.rays, 3, generator=generator).to(total), dim=1)
            # compare both fields there, and their proposal fields
            ours, theirs = (model.field(prepared, model.theta) for model in (self.model, self.reference))
            for mine, wanted in ((ours.field, theirs.field), (ours.proposal, theirs.proposal)):
                if mine is None or wanted is None:
                    continue
                (colour, density), (true_colour, true_density) = mine(points, directions), wanted(points, directions)
                opacity, true_opacity = (thin_opacity(each, bounds) for each in (density, true_density))
                total = total + (colour - true_colour).square().mean() + (opacity - true_opacity).square().mean()
        (total / count).backward()
        return float(total.detach()) / count
