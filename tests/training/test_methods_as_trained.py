"""Learned initialisations and their controls, with trained weights.

Sources of truth: ablation (other pictures, other weights), and, for rates, the first step of Adam, which changes every
weight that has a gradient by the rate (Kingma and Ba 2015, section 2.1).
"""

from dataclasses import replace
from functools import cache

import pytest
import torch

from hyperplanes.adaptation import InitialisationConfig
from hyperplanes.adaptation.fine_tuning import make_descent
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.evaluation import evaluate
from hyperplanes.methods import Request, make_method
from hyperplanes.training import TrainingConfig
from hyperplanes.training.initialisation import initialisation_trainer
from hyperplanes.views import Task
from tests.reference_rendering import Balls, awaken, ball_views, ring, small_model

FAST = TrainingConfig(steps=30, tasks=2, rays=24, evaluate_every=100, checkpoint_every=100, learning_rate=0.02)


class OtherQueries(Balls):
    """The same objects and masks and cameras, with other colours in the query views."""

    def task(self, name):
        task = super().task(name)
        return Task(task.support, replace(task.query, images=task.query.images.flip(1) * 0.5), name)


def trained(method, data=None, steps=30, **changes):
    """The model of a method after `steps` steps, and the losses of the steps."""
    parts = {"inner_steps": 2, "inner_rate": 0.1, "steps": 3, "test_rays": 16, **changes}
    model = small_model(hypernetwork=None, target="nerf", initialisation=InitialisationConfig(method, **parts))
    trainer = initialisation_trainer(model, data or Balls(), FAST, None)
    return model, [trainer.take_step() for _ in range(steps)]


@pytest.fixture(scope="module")
def meta(tmp_path_factory):
    """The checkpoint of a Reptile training."""
    folder = tmp_path_factory.mktemp("mv_meta")
    trained("mv_meta", steps=15)[0].save(folder)
    return folder


@cache
def quality(name, folder, seed=0):
    method = make_method(Request(name, {"mv_meta": folder}, settings=FineTuning(seed=seed)))
    return evaluate(name, method, Balls(), ["test0"]).mean("psnr")


def test_shuffled_weights_have_a_lower_quality(meta):
    assert quality("mv_meta_0", meta) > quality("mv_shuffled_0", meta) + 1
    assert quality("mv_shuffled_0", meta) != quality("mv_shuffled_0", meta, seed=1)


def test_standard_begins_with_random_weights_whatever_was_trained(meta, tmp_path):
    assert quality("mv_meta_0", meta) > quality("standard_0", meta) + 1
    assert quality("standard_0", meta) != quality("standard_0", meta, seed=1)
    trained("mv_meta", steps=3)[0].save(tmp_path)  # a different training of the same architecture
    assert quality("standard_3", meta) == quality("standard_3", tmp_path)


def test_maml_learns_from_query_rays_and_reptile_from_support_rays_only():
    for method, differs in (("maml", True), ("mv_meta", False)):
        (one, _), (other, _) = (trained(method, data, steps=2) for data in (Balls(), OtherQueries()))
        same = all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
        assert same is not differs, method


def test_maml_and_maml_of_first_order_learn_other_weights():
    (second, losses), (first, other) = (
        trained(method, steps=3, inner_rate=0.5) for method in ("maml", "maml_first_order")
    )
    # the losses are equal, except for colours that one method does not render; the gradients are not
    assert losses[0] == pytest.approx(other[0], rel=1e-3)
    moved = torch.cat([(a - b).flatten() for a, b in zip(second.parameters(), first.parameters(), strict=True)])
    assert moved.abs().max() > 1e-3


@pytest.mark.parametrize(("trainable", "rate"), [("hypernetwork", 3e-4), ("weights", 2e-3)])
def test_the_rates_of_fine_tuning_are_those_that_were_measured(trainable, rate):
    # docs/adaptation.md: Adam at 3e-4 for the hypernetwork; at 2e-3 beside Muon for the weights
    model = awaken(small_model())
    context = model.prepare(ball_views(ring(4)))
    settings = FineTuning(trainable)
    descent = make_descent(model, context, settings)
    moments = [value for value in descent.tensors if value.ndim == 1 or trainable == "hypernetwork"]
    before = [value.detach().clone() for value in moments]
    steps = descent.run(10)
    assert [next(steps), next(steps)] == [0, 1]
    moved = torch.cat([(now.detach() - then).abs().flatten() for now, then in zip(moments, before, strict=True)])
    assert float(moved.max()) == pytest.approx(rate, rel=0.02)
