"""Tests of separating an object from its background without masks.

Source of truth: a ball in front of walls, both rendered here in closed form, and the outline of the ball.
"""

import json
from unittest.mock import Mock

import pytest
import torch

from hyperplanes.capture.masks import background
from hyperplanes.capture.masks.background import separate_background
from hyperplanes.commands import view
from hyperplanes.commands.inputs.background import cut_out_task
from hyperplanes.commands.output.console import Console
from hyperplanes.data.formats.scenes.transforms_document import transforms_document
from hyperplanes.export import live
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.views import Task, Views

SIDE, RADIUS, WALLS = 32, 0.6, 4.0


@pytest.fixture(scope="module")
def scene():
    """Views of an orange ball between walls with bluish stripes, and the outlines of the ball."""
    eyes = 2.5 * camera.fibonacci_sphere(14, 1.0)[:, 2, :3]
    lens = camera.symmetric_intrinsics(SIDE, SIDE, 0.9)
    cameras = camera.pinhole(lens, camera.look_at(eyes), SIDE, SIDE)
    images, outlines = [], []
    for row in range(len(eyes)):
        rays = cast(cameras, torch.full((SIDE * SIDE,), row), pixel_grid(SIDE, SIDE))
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
    for name, value in (("LEVELS", ((SIDE, 16, 16, 60),)), ("RAYS_PER_STEP", 192), ("BEFORE", 4), ("BEHIND", 24)):
        monkeypatch.setattr(background, name, value)


def overlap(views, outlines):
    found = views.masks > 0.5
    return float((found & outlines).sum() / (found | outlines).sum())


def test_the_object_is_cut_out_of_support_and_query_views(scene, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path))
    monkeypatch.setattr(background, "LEVELS", ((SIDE, 16, 16, 120),))
    views, outlines = scene
    task = Task(views[:11], views[11:], "ball")
    found = cut_out_task(task, Console())
    assert "background: learned; the object covers " in capsys.readouterr().out
    assert overlap(found.support, outlines[:11]) > 0.75  # the outline of the whole sphere has 0.36
    assert overlap(found.query, outlines[11:]) > 0.75
    corner = found.query.images[..., 0, 0]
    torch.testing.assert_close(corner, torch.ones_like(corner), atol=0.02, rtol=0)
    monkeypatch.setattr(background, "separate_background", None)
    again = cut_out_task(task, Console())
    assert f"kept in {tmp_path}" in capsys.readouterr().out
    assert torch.equal(again.query.masks, found.query.masks)


def test_view_shows_the_object_alone(scene, monkeypatch, tmp_path):
    """The page and the model get the ball over white. The viewer and the model are replaced by mocks."""
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path / "cache"))
    views, outlines = scene
    poses = torch.linalg.inv(camera.camera_from_world(views.cameras).double()).numpy()
    lenses = camera.intrinsics(views.cameras).double().numpy()
    names = [f"{index}.png" for index in range(len(views))]
    sphere = ((0.0, 0.0, 0.0), 1.0)
    document = transforms_document(poses, lenses, views.size, names, sphere=sphere, alternating=False)
    (tmp_path / "transforms.json").write_text(json.dumps(document | {"up": "y"}))
    for name, image in zip(names, views.images, strict=True):
        (tmp_path / name).write_bytes(encode_png((image * 255).round().byte().permute(1, 2, 0).numpy()))
    shown = []

    def interrupted(source, support, *rest):
        shown.append(support)
        raise KeyboardInterrupt

    monkeypatch.setattr(live, "require_viewer", lambda: None)
    monkeypatch.setattr(
        live,
        "LiveViewer",
        lambda support, port, *rest: shown.append(support) or Mock(address=f"http://localhost:{port}"),
    )
    monkeypatch.setattr(view, "load_source", lambda *rest, **named: None)
    monkeypatch.setattr(view, "_adapt", interrupted)
    assert view.run(view.Arguments(tmp_path, learn_background=True)) == 0
    assert len(shown) == 2
    for support in shown:
        assert overlap(support, outlines) > 0.75  # the outline of the whole sphere has 0.36
        corner = support.images[..., 0, 0]
        torch.testing.assert_close(corner, torch.ones_like(corner), atol=0.02, rtol=0)


def test_without_the_outer_grid_the_background_is_in_the_sphere(scene, monkeypatch):
    views, outlines = scene
    read = background._read

    def nothing_outside(grid, points, bounds, lengths):
        depth, colour = read(grid, points, bounds, lengths)
        return (0 * depth, 1 + 0 * colour) if bounds.radius == 2.0 else (depth, colour)

    monkeypatch.setattr(background, "_read", nothing_outside)
    assert overlap(separate_background(views).cut_out(views), outlines) < 0.6


def test_too_few_views_are_refused(scene):
    with pytest.raises(ValueError, match="views: expected at least 5 without lens distortion, got 4"):
        separate_background(scene[0][:4])


def test_views_with_masks_are_not_changed(scene):
    views, outlines = scene
    given = Views(views.images, views.cameras, outlines.float())
    assert cut_out_task(Task(given, given), Console()).support is given


def test_the_background_is_the_same_without_gradients_under_autocast_and_for_cameras_in_double_precision(
    scene, monkeypatch
):
    monkeypatch.setattr(background, "LEVELS", ((16, 8, 8, 3),))
    views, found = scene[0], separate_background(scene[0])
    small = camera.resized(views.cameras, 8, 8)
    picture, _ = found.render(small)
    for mode in (torch.no_grad(), torch.autocast("cpu", torch.bfloat16)):
        with mode:
            assert torch.equal(separate_background(views).inner, found.inner)
            assert torch.equal(found.render(small)[0], picture)
    assert torch.equal(found.render(camera.to(small, dtype=torch.float64))[0], picture)
    with (
        torch.inference_mode(),
        pytest.raises(RuntimeError, match=r"separate_background: expected gradients, got torch\.inference_mode"),
    ):
        separate_background(views)


def test_views_in_double_precision_are_cut_out(scene):
    photographs, outlines = scene
    views = photographs.to("cpu", torch.float64)
    found = separate_background(views).cut_out(views)
    assert found.masks.dtype == torch.float64
    assert overlap(found, outlines) > 0.5
