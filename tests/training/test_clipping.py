"""Source of truth: the gradients of a step with rates of zero, and their norm computed by hand."""

import math
from dataclasses import replace

import pytest
import torch

from hyperplanes.training import Trainer, TrainingConfig
from tests.reference_rendering import Balls, awaken, small_model

CONFIG = TrainingConfig(steps=6, tasks=2, rays=16, evaluate_every=2, checkpoint_every=100, learning_rate=1e-2)


def test_gradients_are_clipped_by_their_norm_over_all_trained_weights():
    free, clipped = (
        Trainer(awaken(small_model()), Balls(), replace(CONFIG, clip=clip, learning_rate=0.0)) for clip in (0.0, 0.01)
    )
    free.take_step()
    clipped.take_step()
    gradients = [
        [value.grad for value in trainer.model.parameters() if value.grad is not None] for trainer in (free, clipped)
    ]
    whole = math.sqrt(sum(float(each.square().sum()) for each in gradients[0]))
    assert whole > 0.02
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(other, one * 0.01 / whole, rtol=1e-3, atol=1e-9)
    norms = clipped.norms()
    assert math.hypot(norms["gradient_theta"], norms["gradient_hypernetwork"]) == pytest.approx(0.01, rel=1e-3)


def test_an_invalid_norm_is_refused():
    with pytest.raises(ValueError, match=r"clip: .*got -1\.0"):
        replace(CONFIG, clip=-1.0)
