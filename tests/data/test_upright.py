"""Source of truth: geometry by hand, and that turning the world and its cameras together changes no picture."""

import pytest
import torch

from hyperplanes.data.upright import upright, upright_task, y_up_from
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Task, Views


def z_up_views(count=5):
    """Cameras around a point off the origin, in a world with z up."""
    generator = torch.Generator().manual_seed(0)
    eyes = torch.randn(count, 3, generator=generator) * 2 + torch.tensor([0.0, 0.0, 6.0])
    pose = camera.look_at(eyes, (0.3, 0.2, 0.5), (0.0, 0.0, 1.0))
    lens = camera.symmetric_intrinsics(6, 8, 0.8).expand(count, 3, 3)
    images = torch.rand(count, 3, 6, 8, generator=generator)
    return Views(images, camera.pinhole(lens, pose, 6, 8), bounds=Sphere((0.3, 0.2, 0.5), 1.5))


def test_up_stays_up_and_lengths_and_handedness_stay():
    turn = y_up_from("z")
    assert (turn @ torch.tensor([0.0, 0, 1, 1], dtype=torch.float64)).tolist() == [0, 1, 0, 1]
    assert torch.equal(turn @ turn.T, torch.eye(4, dtype=torch.float64))
    assert float(torch.linalg.det(turn)) == 1


def test_every_pixel_sees_the_turned_world_as_it_saw_the_world():
    before = z_up_views()
    after = upright(before, "z")
    turn = y_up_from("z")[:3, :3].float()
    for view in range(len(before)):
        old, new = before.rays(view), after.rays(view)
        torch.testing.assert_close(new.origins, old.origins @ turn.T, atol=1e-5, rtol=0)
        torch.testing.assert_close(new.directions, old.directions @ turn.T, atol=1e-6, rtol=0)
        torch.testing.assert_close(torch.stack([new.near, new.far]), torch.stack([old.near, old.far]))
    assert after.images is before.images
    assert after.bounds.centre == pytest.approx((0.3, 0.5, -0.2))
    # what the cameras call up in their pictures was z, and is y
    assert float(camera.camera_from_world(after.cameras)[:, 1, 1].mean()) < -0.5


def test_y_up_is_left_alone_and_another_axis_is_refused():
    views = z_up_views()
    assert upright(views, "y") is views
    task = upright_task(Task(views[:2], views[2:], "x"), "z")
    assert (len(task.support), len(task.query), task.name) == (2, 3, "x")
    with pytest.raises(ValueError, match="one of y, z, got 'x'"):
        upright(views, "x")
