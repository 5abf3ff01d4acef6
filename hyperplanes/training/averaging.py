"""An exponential moving average of a model's weights, for evaluation and for what is saved as the model."""

from __future__ import annotations

from typing import cast

from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from hyperplanes.adaptation.hyperplanes import HyperPlanes

__all__ = ["WeightAverage"]


class WeightAverage(AveragedModel):
    """After each step: decay times the average plus (1 - decay) times the weights; the first step's weights at first.

    Running statistics are averaged alike: those of the last step do not fit the activations of averaged weights.

    Args:
        model: whose weights are averaged.
        decay: below 1; 0.999 averages over about the last 1,000 steps.
    """

    def __init__(self, model: HyperPlanes, decay: float) -> None:
        super().__init__(model, multi_avg_fn=get_ema_multi_avg_fn(decay), use_buffers=True)
        self.requires_grad_(False)

    @property
    def model(self) -> HyperPlanes:
        """The model of the averaged weights."""
        return cast(HyperPlanes, self.module)
