"""An object without masks is told from the room behind it.

Source of truth: a ball in front of walls, both drawn here in closed form, and the outline of the ball.
"""

import pytest
import torch

from hyperplanes.adaptation import background
from hyperplanes.adaptation.background import separate_background
from hyperplanes.commands.background import cut_out_task
from hyperplanes.commands.console import Console
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.views import Task, Views

SIDE, RADIUS, WALLS = 32, 0.6, 4.0


@pytest.fixture(scope="module")
def scene():
    """Views of an orange ball among walls of bluish stripes, and the ball's outlines."""
    eyes = 2.5 * camera.fibonacci_sphere(14, 1.0)[:, 2, :3]
    lens = camera.symmetric_intrinsics(SIDE, SIDE, 0.9)
    cameras = camera.pinhole(lens, camera.look_at(eyes), SIDE, SIDE)
    images, outlines = [], []
    for view in range(len(eyes)):
        rays = cast(cameras, torch.full((SIDE * SIDE,), view), pixel_grid(SIDE, SIDE))
        middle = -(rays.origins * rays.directions).sum(1)
        square = RADIUS**2 - (rays.origins.square().sum(1) - middle**2)
        on_ball = rays.at(middle - square.clamp_min(0).sqrt())
        exit = torch.where(rays.directions > 0, WALLS - rays.origins, -WALLS - rays.origins) / rays.directions
        wall = rays.at(exit.amin(1))
        stripes = 0.5 + 0.4 * torch.sin(1.5 * wall.sum(1, keepdim=True))
        ball = torch.tensor([0.9, 0.5, 0.1]) * (0.7 + 0.3 * torch.sin(6 * on_ball[:, :1]))
        hit = square > 0
        images.append(torch.where(hit[:, None], ball, stripes * torch.tensor([0.3, 0.6, 1.0])).T.reshape(3, SIDE, SIDE))
        outlines.append(hit.reshape(1, SIDE, SIDE))
    return Views(torch.stack(images), cameras), torch.stack(outlines)


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    for name, value in (("LEVELS", ((SIDE, 16, 16, 120),)), ("RAYS", 384), ("BEFORE", 4), ("BEHIND", 24)):
        monkeypatch.setattr(background, name, value)


def overlap(views, outlines):
    found = views.masks > 0.5
    return float((found & outlines).sum() / (found | outlines).sum())


def test_the_object_is_cut_out_of_views_that_were_fitted_and_of_others(scene, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path))
    views, outlines = scene
    task = Task(views[:11], views[11:], "ball")
    found = cut_out_task(task, Console())
    assert "background: learned; the object covers " in capsys.readouterr().out
    assert overlap(found.support, outlines[:11]) > 0.75  # 0.36 of the whole sphere's outline
    assert overlap(found.query, outlines[11:]) > 0.75
    corner = found.query.images[..., 0, 0]
    torch.testing.assert_close(corner, torch.ones_like(corner), atol=0.02, rtol=0)
    monkeypatch.setattr(background, "separate_background", None)
    again = cut_out_task(task, Console())
    assert f"kept in {tmp_path}" in capsys.readouterr().out
    assert torch.equal(again.query.masks, found.query.masks)


def test_without_a_room_the_sphere_holds_it(scene):
    views, outlines = scene
    found = separate_background(views, room=False).cut_out(views)
    assert overlap(found, outlines) < 0.6


def test_too_few_views_are_refused(scene):
    with pytest.raises(ValueError, match="views: expected at least 5 without lens distortion, got 4"):
        separate_background(scene[0][:4])


def test_what_has_masks_stays_as_it_is(scene):
    views, outlines = scene
    given = Views(views.images, views.cameras, outlines.float())
    assert cut_out_task(Task(given, given), Console()).support is given
