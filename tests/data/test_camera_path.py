"""Source of truth: nerfstudio's conventions by hand: OpenGL axes, vertical fov, world coordinates scale (R p + t)."""

import json
import math

import numpy as np
import pytest
import torch

from hyperplanes.data import DataError
from hyperplanes.data.camera_path import read_camera_path
from hyperplanes.geometry import cameras as camera

TURNED = np.array([[0.0, 0, 1, 0.5], [1, 0, 0, -2], [0, 1, 0, 3]])


def document(poses, **more):
    frames = [{"camera_to_world": np.ravel(pose).tolist(), "fov": 90.0, "aspect": 2.0} for pose in poses]
    return {"camera_type": "perspective", "render_width": 40, "render_height": 20, "fps": 2, "seconds": 1.5,
            "keyframes": [], "camera_path": frames, **more}  # fmt: skip


def written(path, content):
    path.write_text(json.dumps(content))
    return path


def poses(count=3):
    """Matrices world_from_camera (view, 4, 4) of cameras around the origin, with OpenGL axes."""
    return camera.opengl_from_opencv(camera.fibonacci_sphere(count, 3.0).double()).numpy()


def test_frames_are_cameras_with_a_vertical_field_of_view(tmp_path):
    """With a fov of 90 degrees, a point as high as it is distant is at the upper border, half a pixel above row 0."""
    level = np.eye(4)
    level[:3, 3] = 0, 0, 2  # looks along -z at the origin, from +2
    found = read_camera_path(written(tmp_path / "a.json", document([level])))
    assert camera.image_size(found.cameras) == (20, 40)
    assert found.seconds == 1.5
    above = torch.tensor([[[0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    torch.testing.assert_close(found.cameras.project(above)[0], torch.tensor([[19.5, -0.5], [19.5, 9.5], [24.5, 9.5]]))
    several = read_camera_path(written(tmp_path / "b.json", document(poses())))
    torch.testing.assert_close(several.cameras.extrinsics, camera.fibonacci_sphere(3, 3.0), atol=1e-5, rtol=0)


def test_nerfstudios_transform_of_the_world_is_inverted(tmp_path):
    """Its world is scale (R p + t). If transforms.json has `applied_transform`, R and t are of the world before it."""
    scale, ours = 0.4, poses()
    theirs = TURNED @ ours
    theirs[:, :, 3] *= scale
    theirs = np.concatenate([theirs, np.tile([[[0.0, 0, 0, 1]]], (3, 1, 1))], 1)
    path = written(tmp_path / "a.json", document(theirs))
    stated = written(tmp_path / "dataparser_transforms.json", {"transform": TURNED.tolist(), "scale": scale})
    found = read_camera_path(path, stated).cameras
    torch.testing.assert_close(found.extrinsics, camera.fibonacci_sphere(3, 3.0), atol=1e-5, rtol=0)
    # for files with A p, nerfstudio writes R A, t, and its factor times that of the files
    applied = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
    whole = np.vstack([TURNED, [0, 0, 0, 1]]) @ np.vstack([applied, [0, 0, 0, 1]])
    stated = written(tmp_path / "b.json", {"transform": whole[:3].tolist(), "scale": 2 * scale})
    scene = {"applied_transform": applied.tolist(), "applied_scale": 2.0}
    found = read_camera_path(path, stated, scene).cameras
    torch.testing.assert_close(found.extrinsics, camera.fibonacci_sphere(3, 3.0), atol=1e-5, rtol=0)
    # for files with only a factor, it writes R, t, and its factor times that of the files
    stated = written(tmp_path / "c.json", {"transform": TURNED.tolist(), "scale": 2 * scale})
    found = read_camera_path(path, stated, {"applied_scale": 2.0}).cameras
    torch.testing.assert_close(found.extrinsics, camera.fibonacci_sphere(3, 3.0), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_path": []}, "expected camera_path, a list of one or more frames, found \\[\\]"),
        ({"camera_path": 3}, "expected camera_path, a list of one or more frames, found 3"),
        (
            {"camera_path": [{"camera_to_world": [1.0] * 15, "fov": 50}]},
            "frame 0 of camera_path: expected a 4 x 4 pose",
        ),
        ({"camera_path": [{"camera_to_world": [2.0] * 16, "fov": 50}]}, "expected a rotation and a translation"),
        ({"camera_path": [{"camera_to_world": "x", "fov": 50}]}, "expected a 4 x 4 pose"),
        ({"camera_path": [{"camera_to_world": np.eye(4).tolist()}]}, "frame 0: degrees above 0 as fov, found None"),
        ({"camera_path": [{"camera_to_world": np.eye(4).tolist(), "fov": 180}]}, "a fov below 180 degrees, found 180"),
        ({"camera_type": "equirectangular"}, "expected camera_type perspective, found 'equirectangular'"),
        ({"camera_type": None}, "expected camera_type perspective, found None"),
        ({"render_width": 0}, "expected a size above 0 as render_width, found 0"),
        ({"render_height": True}, "expected a size above 0 as render_height, found True"),
        ({"render_width": 1e6, "render_height": 1e6}, "found 1000000x1000000"),
        ({"seconds": "2"}, "expected a time above 0 as seconds, found '2'"),
    ],
)
def test_an_invalid_path_is_refused(tmp_path, change, message):
    with pytest.raises(DataError, match=message):
        read_camera_path(written(tmp_path / "a.json", document(poses(1), **change)))


def test_ignored_fields_are_reported(tmp_path):
    path = written(tmp_path / "a.json", document(poses(1), crop={"crop_scale": [1, 1, 1]}))
    assert read_camera_path(path).notes == ("its crop is left out",)
    path = written(tmp_path / "b.json", document(poses(1), crop=None, render_time=None))
    assert read_camera_path(path).notes == ()
    assert math.isclose(read_camera_path(path).seconds, 1.5)
