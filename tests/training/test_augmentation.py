"""Augmentation of episodes. Source of truth: projection of rotated points, and volumes of the rotated views."""

from collections import Counter
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.training import Trainer
from hyperplanes.training.augmentation import DARKEST, Augmentation, draw_augmentation
from hyperplanes.training.episodes import whole_of
from hyperplanes.views import Task
from tests.reference_rendering import Balls
from tests.training.test_completion import MODEL, TRAINING


def test_rotated_cameras_see_rotated_points_where_the_others_saw_them():
    views = Balls(views=5).task("train0").support
    views = replace(views, bounds=Sphere((0.3, -0.2, 0.1), 0.8))
    rotated = Augmentation(angle=0.7).views(views)
    points = torch.tensor([[0.3, 0.5, 0.1], [0.5, 0.1, -0.2], [0.0, -0.4, 0.3]])
    axis = torch.tensor([0.3, 0.0, 0.1])
    cos, sin = torch.cos(torch.tensor(0.7)), torch.sin(torch.tensor(0.7))
    x, y, z = (points - axis).unbind(1)
    moved = torch.stack([cos * x + sin * z, y, -sin * x + cos * z], 1) + axis
    assert torch.allclose(moved[0], points[0])  # a point of the axis stays
    for one, other in ((views, points), (rotated, moved)):
        pixels = one.cameras.project(other[None].expand(len(one), -1, -1))
        expected = pixels if one is views else expected
    torch.testing.assert_close(pixels, expected, atol=1e-3, rtol=1e-4)
    assert rotated.images is views.images


@pytest.mark.parametrize("angle", [0.5, 2.0, 4.4])
def test_a_rotated_volume_is_that_of_the_rotated_views(angle):
    model, task = HyperPlanes(MODEL), Balls(views=16, size=(40, 40)).task("train0")
    beside = Sphere((0.4, 0.0, 0.2))  # the ball is not in the middle of the scene
    task = Task(*(replace(part, bounds=beside) for part in (task.support, task.query)))
    drawn = Augmentation(angle, (2, 0, 1), (0.7, 1.0, 0.9))
    expected = whole_of(model, Task(drawn.views(task.support), drawn.views(task.query))).float()
    share = expected[:1]

    def errors(change):
        found = change.volume(whole_of(model, task)).float()
        return float((found[:1] - share).abs().mean()), float(((found[1:] - expected[1:]).abs() * share).mean())

    place, colours = errors(drawn)
    assert place < errors(replace(drawn, angle=0.0))[0] / 3
    assert place < errors(replace(drawn, angle=-angle))[0] / 3
    assert colours < errors(replace(drawn, channels=(0, 1, 2)))[1] / 3
    assert colours < errors(replace(drawn, factors=(1.0, 0.7, 0.9)))[1] / 1.5


def test_white_background_stays_white_and_masks_stay():
    views = Balls(views=4).task("train0").support
    changed = Augmentation(channels=(1, 2, 0), factors=(1.0, 0.6, 0.8)).views(views)
    assert torch.equal(changed.masks, views.masks)
    empty = (views.masks == 0).expand_as(views.images)
    assert torch.equal(changed.images[empty], views.images[empty])
    whole = (views.masks == 1)[:, 0]
    for channel, (source, factor) in enumerate(((1, 1.0), (2, 0.6), (0, 0.8))):
        torch.testing.assert_close(changed.images[:, channel][whole], factor * views.images[:, source][whole])
    assert 0 <= float(changed.images.min()) <= float(changed.images.max()) <= 1


def test_as_many_episodes_are_changed_as_asked_for():
    drawn = [draw_augmentation(0.5, 0.25, torch.Generator().manual_seed(seed)) for seed in range(800)]
    assert sum(each.angle != 0 for each in drawn) == pytest.approx(400, abs=60)
    recoloured = [each for each in drawn if each.factors != (1.0, 1.0, 1.0)]
    assert len(recoloured) == pytest.approx(200, abs=50)
    assert len(Counter(each.channels for each in recoloured)) == 6
    assert all(DARKEST <= factor <= 1 for each in recoloured for factor in each.factors)
    assert draw_augmentation(0.0, 0.0, torch.Generator()) == Augmentation()


def test_a_training_shows_changed_objects_with_their_volumes_and_goes_on_where_it_stopped(tmp_path):
    config = replace(TRAINING, rotations=1.0, recolouring=1.0, checkpoint_every=2)
    plain, changed = (Trainer(HyperPlanes(MODEL), Balls(size=(24, 24)), each) for each in (TRAINING, config))
    name = changed._numbered(0)
    one, other = plain._load(name), changed._load(name)
    assert one.prepared.views.images.shape[1:] == other.prepared.views.images.shape[1:]
    assert not torch.equal(camera.centres(one.query.cameras), camera.centres(other.query.cameras))
    assert not torch.equal(one.whole, other.whole)
    while changed.step < 4:
        changed.take_step()
    first = Trainer(HyperPlanes(MODEL), Balls(size=(24, 24)), config, tmp_path)
    first.take_step()
    first.take_step()
    first.save()
    second = Trainer(HyperPlanes(MODEL), Balls(size=(24, 24)), config, tmp_path)
    assert second.step == 2
    list(second.run())
    for key, value in changed.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[key]), key


@pytest.mark.parametrize(("name", "share"), [("rotations", 1.5), ("recolouring", -0.1)])
def test_shares_that_are_none_and_trainings_without_episodes_are_refused(name, share):
    with pytest.raises(ValueError, match=f"{name}: expected a share from 0 to 1"):
        replace(TRAINING, **{name: share})
    config = replace(TRAINING, views=(), completion=0.0, **{name: 0.5})
    with pytest.raises(ValueError, match=f"training.{name}: expected 0 without training.views, got 0.5"):
        Trainer(HyperPlanes(MODEL), Balls(), config)
