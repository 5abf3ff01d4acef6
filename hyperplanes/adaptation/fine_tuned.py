"""Methods that take gradient steps on the support views of each object, from trained or from random weights."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace

import torch

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.fields import find_targets
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.views import Views

__all__ = ["SCRATCH_RATES", "FieldFromScratch", "FineTuned", "FromScratch", "random_model", "shuffled"]

SCRATCH_RATES = {"learning_rate": 4e-3, "muon_learning_rate": 0.05}
"""Of Adam and Muon from random weights: higher than those of fine-tuning (docs/adaptation.md). A field may have its own
(`Target.fine_tuning_rates`)."""


@dataclass(frozen=True)
class FineTuned:
    """A model that is fine-tuned on the support views of each object.

    Attributes:
        model: never changed.
        steps: on each object, or "auto".
        settings: of fine-tuning.
    """

    model: HyperPlanes
    steps: Steps
    settings: FineTuning = field(default_factory=FineTuning)

    @checked
    def adapt(self, support: Views) -> AdaptedField:
        """The field after fine-tuning on the support views."""
        return self.model.fine_tune(support, self.steps, self.settings)


@dataclass(frozen=True)
class FromScratch:
    """The target network of a model, optimised on the support views of each object from random weights.

    A control for fine-tuning: the same field, planes, rays and number of steps, without what training has learned.

    Attributes:
        model: whose architecture and rig are used, but not its weights.
        steps: on each object, or "auto".
        settings: of the optimisation. Rates that are None become SCRATCH_RATES, the seed is also that of the random
            weights, and all weights are trained.
    """

    model: HyperPlanes
    steps: Steps
    settings: FineTuning = field(default_factory=FineTuning)

    @checked
    def adapt(self, support: Views) -> AdaptedField:
        """The field after the steps; the views are reflected by the symmetry that the model finds."""
        symmetry = self.model.find_symmetry(support)
        fresh = random_model(replace(self.model.config, symmetric=False, symmetry=symmetry), self.settings.seed)
        fresh.rig.copy_(self.model.rig)
        settings = _rated(self.settings, fresh)
        return fresh.to(self.model.rig).fine_tune(support, self.steps, settings)


@dataclass(frozen=True)
class FieldFromScratch:
    """A target network for each object, optimised on its support views from random weights.

    No checkpoint is needed: each support view is an ImagePlane, in the order of the views.

    Attributes:
        config: of the field; its number of planes is used only for fields that take any number of views.
        steps: on each object, or "auto".
        settings: as in `FromScratch`.
        device: of the field.
    """

    config: ModelConfig
    steps: Steps
    settings: FineTuning = field(default_factory=FineTuning)
    device: torch.device | str = "cpu"

    @checked
    def adapt(self, support: Views) -> AdaptedField:
        """The field after the steps."""
        planes = (
            self.config.network.planes if find_targets()[self.config.target].permutation_invariant else len(support)
        )
        network = replace(self.config.network, planes=planes)
        fresh = random_model(replace(self.config, network=network, order="file"), self.settings.seed).to(self.device)
        settings = _rated(self.settings, fresh)
        return fresh.fine_tune(support, self.steps, settings)


def random_model(config: ModelConfig, seed: int) -> HyperPlanes:
    """The target network of a model alone, with random weights."""
    return HyperPlanes(config.target_alone(), seed=seed)


def _rated(settings: FineTuning, model: HyperPlanes) -> FineTuning:
    """The settings for training all weights, with the rates for random weights where they state none."""
    return replace(settings, trainable="weights").with_rates(model.target.fine_tuning_rates or SCRATCH_RATES)


@torch.no_grad()
def shuffled(model: HyperPlanes, seed: int = 0) -> HyperPlanes:
    """The model with the entries of each weight matrix and bias in random order ("Shuffled" in Tancik et al. 2021).

    Each keeps its mean and variance and loses everything else that was learned.

    Args:
        model: not changed.
        seed: of the order.
    """
    result = copy.deepcopy(model)
    generator = torch.Generator().manual_seed(seed)
    for value in result.networks.parameters():
        order = torch.randperm(value.numel(), generator=generator).to(value.device)
        value.copy_(value.flatten()[order].reshape(value.shape))
    return result
