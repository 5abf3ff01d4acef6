"""Source of truth: geometry by hand. Rotating the world and its cameras together changes no picture."""

import json
from dataclasses import replace

import pytest
import torch
from PIL import Image

from hyperplanes.data import open_dataset, read_task, read_views
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.data.upright import _direction, guess_up, upright, upright_task, y_up_from
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Task, Views

FLIP = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)  # OpenCV's camera axes to OpenGL's


def z_up_views(count=5):
    """Cameras around a point that is not the origin, in a world with z up."""
    generator = torch.Generator().manual_seed(0)
    eyes = torch.randn(count, 3, generator=generator) * 2 + torch.tensor([0.0, 0.0, 6.0])
    pose = camera.look_at(eyes, (0.3, 0.2, 0.5), (0.0, 0.0, 1.0))
    lens = camera.symmetric_intrinsics(6, 8, 0.8).expand(count, 3, 3)
    images = torch.rand(count, 3, 6, 8, generator=generator)
    return Views(images, camera.pinhole(lens, pose, 6, 8), bounds=Sphere((0.3, 0.2, 0.5), 1.5))


def test_the_matrix_to_y_up_is_a_rotation_that_maps_z_to_y():
    turn = y_up_from("z")
    assert (turn @ torch.tensor([0.0, 0, 1, 1], dtype=torch.float64)).tolist() == [0, 1, 0, 1]
    assert torch.equal(turn @ turn.T, torch.eye(4, dtype=torch.float64))
    assert float(torch.linalg.det(turn)) == 1


def test_the_rays_of_all_pixels_are_rotated_with_the_world():
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
    # up in the pictures was z and is now y
    assert float(camera.camera_from_world(after.cameras)[:, 1, 1].mean()) < -0.5


def test_y_up_changes_nothing_and_an_invalid_axis_is_refused():
    views = z_up_views()
    assert upright(views, "y") is views
    assert upright(replace(views, up="z"), "y").up == "y", "as the caller says, whatever the files say"
    task = upright_task(Task(views[:2], views[2:], "x"), "z")
    assert (len(task.support), len(task.query), task.name) == (2, 3, "x")
    for wrong in ("w", "1,2", "0,0,0", "nan,0,1", ""):
        with pytest.raises(ValueError, match=f"up: expected one of y, z, .* got '{wrong}'"):
            upright(views, wrong)


@pytest.mark.parametrize("up", ["y", "z", "x", "-y", "-z", "-x", "0.3,0.8,-0.5"])
def test_up_is_guessed_from_level_cameras_and_becomes_y(up):
    """Cameras look at one place and are level in a world with that direction up. The matrix is a rotation."""
    x, y, z = axis = _direction(up).tolist()
    generator = torch.Generator().manual_seed(1)
    eyes = torch.nn.functional.normalize(torch.randn(12, 3, generator=generator), dim=-1) * 3
    cameras = camera.pinhole(
        camera.symmetric_intrinsics(4, 4, 0.7), camera.look_at(eyes, (0.1, 0.0, 0.2), (x, y, z)), 4, 4
    )
    guessed = guess_up(cameras)
    assert _direction(guessed).tolist() == pytest.approx(axis, abs=1e-3)
    assert guessed == up or up[0] == "0"
    turn = y_up_from(up)
    assert (turn[:3, :3] @ _direction(up)).tolist() == pytest.approx([0, 1, 0])
    assert torch.allclose(turn[:3, :3] @ turn[:3, :3].T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(turn)) == pytest.approx(1)


def test_up_is_not_guessed_from_cameras_with_random_roll():
    """With random rotations, there is no up for which all cameras are level."""
    generator = torch.Generator().manual_seed(2)
    rotation = torch.linalg.qr(torch.randn(20, 3, 3, generator=generator))[0]
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    pose = torch.eye(4).repeat(20, 1, 1)
    pose[:, :3, :3] = rotation
    assert guess_up(camera.pinhole(camera.symmetric_intrinsics(4, 4, 0.7), pose, 4, 4)) is None


def test_scenes_are_read_upright_if_requested(tmp_path):
    """Level cameras in a world with z up. Source of truth: `upright` of the views as they are read."""
    eyes = torch.tensor([[3.0, 0.0, 1.0], [0.0, 3.0, 1.0], [-3.0, 0.0, 1.0], [0.0, -3.0, 1.0]])
    pose = camera.look_at(eyes, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).double()
    frames = [
        {"file_path": f"{view}.png", "transform_matrix": (torch.linalg.inv(one) * FLIP).tolist()}
        for view, one in enumerate(pose)
    ]
    for frame in frames:
        Image.new("RGBA", (8, 8), "red").save(tmp_path / frame["file_path"])
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    as_it_is = read_views(tmp_path)
    expected = camera.camera_from_world(upright(as_it_is, "z").cameras)
    assert torch.allclose(camera.camera_from_world(as_it_is.cameras), pose.float(), atol=1e-5)
    for up in ("auto", "z", "0,0,3"):
        assert torch.equal(camera.camera_from_world(read_views(tmp_path, up=up).cameras), expected)
        task = read_task(tmp_path, up=up)
        assert torch.equal(camera.camera_from_world(task.support.cameras), expected[::2])
        assert torch.equal(camera.camera_from_world(task.query.cameras), expected[1::2])
    with pytest.raises(ValueError, match="up: expected one of y, z, .* got 'w'"):
        read_task(tmp_path, up="w")


def test_each_scene_of_a_folder_is_rotated_by_its_own_up(scene, tmp_path):
    for name, up in (("a", "z"), ("b", "y")):
        scene.write(tmp_path / name, scene.document(up=up))
    data = open_dataset(tmp_path)
    on_device = TasksOnDevice(data, torch.device("cpu"))
    for name, up in (("a", "z"), ("b", "y")):
        expected = upright_task(data.task(name), up).support.cameras
        found = on_device.task(name).support.cameras
        assert torch.equal(camera.camera_from_world(found), camera.camera_from_world(expected))
