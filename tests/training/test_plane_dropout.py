"""Source of truth: ablation. Only a field that was trained with plane dropout keeps its quality without some planes."""

from itertools import combinations

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.fields import find_targets
from hyperplanes.rendering import RayMarching
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.utilities.images.metrics import psnr
from tests.reference_rendering import Balls, small_model

CONFIG = TrainingConfig(steps=120, tasks=1, rays=96, learning_rate=6e-3, final_rate_factor=0.1, held_out=0)
DATA = Balls(train=8, test=2)


def trained(dropout):
    model = small_model(hypernetwork=None, plane_dropout=dropout, sampling=RayMarching(12))
    trainer = Trainer(model, DATA, CONFIG)
    while trainer.step < CONFIG.steps:
        trainer.take_step()
    return model.eval()


def qualities(model):
    """PSNR in dB for held-out balls: with all planes, and the means with each one and with each two planes hidden."""
    tasks = [DATA.task(name) for name in ("test0", "test1")]
    contexts = [model.prepare(task.support) for task in tasks]
    queries = [task.query[::2] for task in tasks]
    rays = [query.rays_at(torch.arange(query.images[:, 0].numel()))[0] for query in queries]  # of all pixels

    @torch.no_grad()
    def quality(hidden):
        masked = [context.mask_views(torch.tensor(hidden, dtype=torch.long)) for context in contexts]
        fields = [model.field(each, model.theta) for each in masked]
        seen = [field.trace(each, differentiable=False).colour for field, each in zip(fields, rays, strict=True)]
        truth = torch.cat([query.images for query in queries])
        return psnr(torch.cat(seen).unflatten(0, (len(truth), *truth.shape[2:])).permute(0, 3, 1, 2), truth).mean()

    count = model.config.network.planes
    return [torch.stack(list(map(quality, combinations(range(count), hidden)))).mean() for hidden in range(3)]


def test_a_field_trained_with_dropout_keeps_its_quality_without_some_planes():
    (all_planes, one_hidden, two_hidden), without = qualities(trained(0.3)), qualities(trained(0.0))
    assert all_planes > without[0] - 0.5  # measured: 0.2 dB better
    assert one_hidden > without[1] + 0.5  # measured: 1.0 dB
    assert two_hidden > without[2] + 1.0  # measured: 1.8 dB


@pytest.mark.parametrize("order", ["matched", "file"])
def test_with_fewer_views_than_planes_each_is_one_plane_and_the_others_are_hidden(order):
    support, seen = DATA.task("test0").support, torch.tensor([2, 0])
    filled, dropped = (
        small_model(hypernetwork=None, plane_dropout=chance, order=order).prepare(support[seen]) for chance in (0, 0.3)
    )
    assert filled.planes.masked is None
    assert (
        dropped.planes.masked.tolist()
        == {"matched": [False, True, False, True], "file": [False, False, True, True]}[order]
    )
    assert torch.equal(filled.views.images, dropped.views.images)
    both = dropped.mask_views(torch.tensor([0]))  # hidden planes stay hidden
    assert both.planes.masked.sum() == 3
    assert small_model(hypernetwork=None, plane_dropout=0.3, order=order).prepare(support).planes.masked is None


@pytest.mark.parametrize("target", ["nerf", "image_based"])
def test_fields_without_individual_planes_refuse_dropout(target):
    network = find_targets()[target].config_type()
    with pytest.raises(ValueError, match=f"plane_dropout: .* got {target}"):
        HyperPlanes(ModelConfig(target=target, network=network, hypernetwork=None, plane_dropout=0.1))
    with pytest.raises(ValueError, match="plane_dropout: expected a probability from 0 to below 1, got 1"):
        ModelConfig(plane_dropout=1.0)
