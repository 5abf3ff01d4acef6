"""Rotation of episodes. Source of truth: projections of rotated points, and volumes of rotated views."""

import math
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.alignment.rotation import Rotation
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.training import Trainer
from hyperplanes.training.episodes.augmentation import draw_rotation, rotated_volume
from hyperplanes.training.episodes.episode import volume_of_all_views
from hyperplanes.views import Task
from tests.reference_rendering import Balls
from tests.training.test_volume_loss import MODEL, TRAINING


def test_rotated_cameras_project_rotated_points_to_the_same_pixels():
    views = Balls(views=5).task("train0").support
    views = replace(views, bounds=Sphere((0.3, -0.2, 0.1), 0.8))
    rotated = Rotation(0.7).views(views)
    points = torch.tensor([[0.3, 0.5, 0.1], [0.5, 0.1, -0.2], [0.0, -0.4, 0.3]])
    axis = torch.tensor([0.3, 0.0, 0.1])
    cos, sin = torch.cos(torch.tensor(0.7)), torch.sin(torch.tensor(0.7))
    x, y, z = (points - axis).unbind(1)
    moved = torch.stack([cos * x + sin * z, y, -sin * x + cos * z], 1) + axis
    assert torch.allclose(moved[0], points[0])  # a point of the axis does not move
    for one, other in ((views, points), (rotated, moved)):
        pixels = one.cameras.project(other[None].expand(len(one), -1, -1))
        expected = pixels if one is views else expected
    torch.testing.assert_close(pixels, expected, atol=1e-3, rtol=1e-4)
    assert rotated.images is views.images


@pytest.mark.parametrize("angle", [0.5, 2.0, 4.4])
def test_a_rotated_volume_is_that_of_the_rotated_views(angle):
    model, task = HyperPlanes(MODEL), Balls(views=16, size=(40, 40)).task("train0")
    beside = Sphere((0.4, 0.0, 0.2))  # the ball is not at the centre of the scene
    task = Task(*(replace(part, bounds=beside) for part in (task.support, task.query)))
    drawn = Rotation(angle)
    expected = volume_of_all_views(model, Task(drawn.views(task.support), drawn.views(task.query))).float()
    share = expected[:1]

    def errors(change):
        found = rotated_volume(volume_of_all_views(model, task), change).float()
        return float((found[:1] - share).abs().mean()), float(((found[1:] - expected[1:]).abs() * share).mean())

    place, colours = errors(drawn)
    for wrong in (Rotation(0.0), Rotation(-angle)):
        assert place < errors(wrong)[0] / 3
        assert colours < errors(wrong)[1]


def test_the_given_share_of_episodes_is_rotated():
    angles = [draw_rotation(0.25, torch.Generator().manual_seed(seed)).angle for seed in range(800)]
    rotated = torch.tensor([angle for angle in angles if angle])
    assert len(rotated) == pytest.approx(200, abs=50)
    quarters = torch.histc(rotated, 4, 0, 2 * math.pi)
    assert quarters.min() > 30
    assert draw_rotation(0.0, torch.Generator()) == Rotation()


def test_a_training_uses_rotated_objects_with_their_volumes_and_can_be_resumed(tmp_path):
    config = replace(TRAINING, steps=2, rotations=1.0)
    plain, changed = (Trainer(HyperPlanes(MODEL), Balls(size=(24, 24)), each) for each in (TRAINING, config))
    name = changed.loader.names_of(0)[0]
    one, other = plain.loader.get(name), changed.loader.get(name)
    assert one.prepared.views.images.shape[1:] == other.prepared.views.images.shape[1:]
    assert not torch.equal(camera.centres(one.query.cameras), camera.centres(other.query.cameras))
    assert not torch.equal(one.target_volume, other.target_volume)
    while changed.step < 2:
        changed.take_step()
    first = Trainer(HyperPlanes(MODEL), Balls(size=(24, 24)), config, tmp_path)
    first.take_step()
    first.save()
    second = Trainer(HyperPlanes(MODEL), Balls(size=(24, 24)), config, tmp_path)
    assert second.step == 1
    list(second.run())
    for key, value in changed.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[key]), key


@pytest.mark.parametrize("share", [1.5, -0.1])
def test_invalid_shares_and_trainings_without_episodes_are_refused(share):
    with pytest.raises(ValueError, match="rotations: expected a share from 0 to 1"):
        replace(TRAINING, rotations=share)
    config = replace(TRAINING, views=(), volume_loss=0.0, rotations=0.5)
    with pytest.raises(ValueError, match=r"training.rotations: expected 0 without training.views, got 0.5"):
        Trainer(HyperPlanes(MODEL), Balls(), config)
