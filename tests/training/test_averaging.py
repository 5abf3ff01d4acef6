"""Source of truth: a loop beside the trainer that averages copies of the weights."""

import math
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.utilities.checkpoints import load_tensors
from hyperplanes.utilities.metrics import psnr
from tests.reference_rendering import Balls, awaken, small_model

CONFIG = TrainingConfig(steps=6, tasks=2, rays=16, evaluate_every=2, checkpoint_every=100, learning_rate=1e-2)


def parameters_of(model):
    return {name: value.detach().clone() for name, value in model.state_dict().items()}


def test_the_average_is_that_of_the_weights_after_every_step_and_is_what_is_judged_and_saved(tmp_path):
    data = Balls(test=1)
    trainer = Trainer(awaken(small_model()), data, replace(CONFIG, average=0.75), tmp_path)
    plain = Trainer(awaken(small_model()), data, CONFIG)
    expected = None
    for _ in range(4):
        assert trainer.take_step() == plain.take_step()  # the training goes on from the weights themselves
        weights = parameters_of(trainer.model)
        expected = weights if expected is None else {k: 0.75 * expected[k] + 0.25 * weights[k] for k in weights}
    averaged = parameters_of(trainer.evaluated)
    running = {name for name, _ in trainer.model.named_buffers() if name != "rig"}
    assert any((averaged[name] - weights[name]).abs().max() > 1e-3 for name in running)  # these move too
    for name, value in expected.items():
        torch.testing.assert_close(averaged[name], value)
    assert any((averaged[name] - value).abs().max() > 1e-3 for name, value in weights.items())
    trainer.save()
    loaded = HyperPlanes.from_pretrained(tmp_path)
    for name, value in averaged.items():
        assert torch.equal(loaded.state_dict()[name], value)
    state = load_tensors(next(tmp_path.glob("training-*.safetensors")))
    assert all(torch.equal(state[f"model.{name}"], value) for name, value in weights.items())

    task = data.task("test0")
    views = task.query[[0, 2]]
    shown = psnr(loaded.adapt(task.support).render(views.cameras).images, views.images).mean()
    assert trainer.look()[0] == pytest.approx(shown.item())
    assert trainer.look()[0] != plain.look()[0]


def test_gradients_are_clipped_by_their_norm_over_all_weights_that_move():
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


@pytest.mark.parametrize(
    ("change", "message"), [({"average": 1.0}, "average: .*got 1.0"), ({"clip": -1.0}, "clip: .*got -1.0")]
)
def test_a_decay_or_a_norm_that_means_nothing_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **change)
