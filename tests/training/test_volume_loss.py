"""The volume loss. Source of truth: grids that are correct by construction, and weights that a step must not change."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes, ModelConfig
from hyperplanes.fields import ImageBasedConfig
from hyperplanes.hypernetwork import ImageHyperNetworkConfig, VolumeHyperNetworkConfig
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import RayMarching
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.training.episodes.episode import prepare_subset, volume_of_all_views
from hyperplanes.training.losses import VolumeLoss
from tests.reference_rendering import Balls

MODEL = ModelConfig(
    "image_based",
    ImageBasedConfig(depth=2, width=16, planes=4, blended=2, grid=5, point_frequencies=2, direction_frequencies=1),
    VolumeHyperNetworkConfig(),
    sampling=RayMarching(24),
    hull_resolution=32,
)
TRAINING = TrainingConfig(
    steps=4, tasks=2, rays=32, views=(1, 3), episodes=4, volume_loss=0.1, hypernetwork_learning_rate=3e-3, held_out=0
)


def episode(model, count=2, seed=0):
    task = Balls(views=8, size=(24, 24)).task("train0")
    return prepare_subset(model, task, (count,), torch.Generator().manual_seed(seed), volume_of_all_views(model, task))


def volume_loss(parameters, shown):
    return VolumeLoss(1.0)(SimpleNamespace(parameters=parameters, episode=shown))


def weights(grid):
    return Parameters({"fine.grid.weight": grid})


def test_the_true_hull_and_colours_have_the_smallest_loss():
    model = HyperPlanes(MODEL)
    shown = episode(model)
    whole = shown.target_volume.float()
    share = whole[:1].clamp(1e-4, 1 - 1e-4)
    right = torch.cat([torch.logit(share), whole[1:], torch.zeros(1, *share.shape[1:])])
    least = float(volume_loss(weights(right), shown))
    for wrong in (torch.zeros_like(right), right + 0.5, right.flip(1)):
        assert float(volume_loss(weights(wrong), shown)) > least + 0.01


def test_an_object_whose_volume_cannot_be_made_is_named():
    task = Balls(views=8, size=(24, 24)).task("train0")
    blank = replace(task, support=replace(task.support, masks=torch.zeros_like(task.support.masks)))
    with pytest.raises(ValueError, match="train0: masks of the support views: expected an object"):
        volume_of_all_views(HyperPlanes(MODEL), replace(blank, query=blank.support))


def test_only_cells_in_the_hull_of_the_shown_views_and_the_first_features_count():
    model = HyperPlanes(MODEL)
    shown = episode(model)
    left = shown.prepared.volume[0] > 0
    assert bool((left & (shown.target_volume[0] == 0)).any())  # the hull of few views is larger
    grid = torch.zeros(5, *left.shape, requires_grad=True)
    volume_loss(weights(grid), shown).backward()
    assert bool((grid.grad[0, left] != 0).all())
    assert not grid.grad[:, ~left].any()
    assert not grid.grad[4:].any()


def test_a_training_learns_parts_that_the_shown_views_do_not_show():
    model = HyperPlanes(MODEL)
    trainer = Trainer(model, Balls(views=8, size=(24, 24)), replace(TRAINING, steps=12, volume_loss=1.0))
    shown = episode(model)

    def loss():
        with torch.no_grad():
            return float(volume_loss(model.theta + model.eval().update(shown.prepared), shown))

    before = loss()
    while trainer.step < 12:
        trainer.take_step()
    assert loss() < 0.7 * before


def test_a_resumed_training_is_equal_to_an_uninterrupted_one(tmp_path):
    config = replace(TRAINING, steps=2)
    whole = Trainer(HyperPlanes(MODEL), Balls(), config)
    list(whole.run())
    first = Trainer(HyperPlanes(MODEL), Balls(), config, tmp_path)
    first.take_step()
    first.save()
    second = Trainer(HyperPlanes(MODEL), Balls(), config, tmp_path)
    assert second.step == 1
    list(second.run())
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name


@pytest.mark.parametrize(
    ("changes", "training"),
    [
        ({"network": replace(MODEL.network, grid=3)}, TRAINING),
        ({"hypernetwork": ImageHyperNetworkConfig(views=2, code=8, depth=1, width=16, join="mean")}, TRAINING),
        ({}, replace(TRAINING, views=())),
    ],
)
def test_models_and_trainings_that_do_not_support_the_loss_are_refused(changes, training):
    with pytest.raises(ValueError, match=r"training\.volume_loss: expected .*, got views "):
        Trainer(HyperPlanes(replace(MODEL, **changes)), Balls(), training)
