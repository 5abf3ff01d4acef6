"""Source of truth: taking away. A field trained with dropout of planes does without some; without it, it does not."""

from functools import cache

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.fields import find_targets
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.utilities.metrics import psnr
from tests.reference_rendering import Balls, small_model

CONFIG = TrainingConfig(steps=200, tasks=2, rays=48, learning_rate=3e-3, held_out=0)


@cache
def trained(dropout):
    model = small_model(hypernetwork=None, plane_dropout=dropout)
    trainer = Trainer(model, Balls(train=8, test=2), CONFIG)
    while trainer.step < CONFIG.steps:
        trainer.take_step()
    return model.eval()


def quality(model, hidden):
    """Mean PSNR of the held-out balls, in dB."""
    found = []
    for name in ("test0", "test1"):
        task = Balls(train=8, test=2).task(name)
        prepared = model.prepare(task.support).mask_views(torch.tensor(hidden, dtype=torch.long))
        with torch.no_grad():
            pictures = model.field(prepared, model.theta).render(task.query.cameras)
        found.append(psnr(pictures.images, task.query.images).mean())
    return float(torch.stack(found).mean())


def test_a_field_trained_with_dropout_does_without_some_planes():
    with_it, without = trained(0.3), trained(0.0)
    assert quality(with_it, []) > quality(without, []) - 0.5  # measured: half a dB better
    for hidden, gain in (([0], 0.5), ([1, 2], 1.0)):  # measured: 1.2 and 2.3 dB
        assert quality(with_it, hidden) > quality(without, hidden) + gain


@pytest.mark.parametrize("order", ["matched", "file"])
def test_where_there_are_fewer_views_than_planes_each_stands_at_one_plane_and_the_others_are_hidden(order):
    support, seen = Balls(train=8, test=2).task("test0").support, torch.tensor([2, 0])
    filled, dropped = (
        small_model(hypernetwork=None, plane_dropout=chance, order=order).prepare(support[seen]) for chance in (0, 0.3)
    )
    assert filled.planes.masked is None
    assert (
        dropped.planes.masked.tolist()
        == {"matched": [False, True, False, True], "file": [False, False, True, True]}[order]
    )
    assert torch.equal(filled.views.images, dropped.views.images)
    both = dropped.mask_views(torch.tensor([0]))  # what is hidden stays so
    assert both.planes.masked.sum() == 3
    assert small_model(hypernetwork=None, plane_dropout=0.3, order=order).prepare(support).planes.masked is None


@pytest.mark.parametrize("target", ["nerf", "image_based"])
def test_fields_without_a_plane_at_a_place_of_its_own_take_no_dropout(target):
    network = find_targets()[target].config_type()
    with pytest.raises(ValueError, match=f"plane_dropout: .* got {target}"):
        HyperPlanes(ModelConfig(target=target, network=network, hypernetwork=None, plane_dropout=0.1))
    with pytest.raises(ValueError, match="plane_dropout: expected a probability from 0 to below 1, got 1"):
        ModelConfig(plane_dropout=1.0)
