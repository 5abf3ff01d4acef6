"""Source of truth: the ball of conftest, in files as COLMAP's documentation describes them; OpenCV's distortion."""

import struct

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from hyperplanes.data import DataError, open_dataset, read_task, read_views
from hyperplanes.data.formats.scenes.colmap import read_colmap
from hyperplanes.data.pictures.undistort import distort, undistort
from hyperplanes.geometry import cameras as camera

COEFFICIENTS = (-0.12, 0.05, 0.01, -0.008, 0.02, 0.01, -0.02, 0.005)
IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 5}


def write(scene, folder, model="PINHOLE", extra=(), binary=False):
    (folder / "images").mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    focal, x, y = scene.matrix[0, 0], scene.matrix[0, 2] + 0.5, scene.matrix[1, 2] + 0.5
    parameters = ([focal] if "SIMPLE" in model else [focal, focal]) + [x, y, *extra]
    height, width = scene.size
    images = []
    for index, pose in enumerate(scene.camera_from_world):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        name = f"view{7 - index}.png"  # COLMAP's order differs from that of the names
        Image.fromarray(scene.pictures[index]).save(folder / "images" / name)
        images.append(([w, x, y, z, *pose[:3, 3]], name))
    home = folder / "sparse/0"
    if binary:
        head = struct.pack("<QiiQQ", 1, 3, IDS[model], width, height)
        (home / "cameras.bin").write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))
        data = struct.pack("<Q", len(images))
        for index, (numbers, name) in enumerate(images):
            data += struct.pack("<i7di", index, *numbers, 3) + name.encode() + b"\0"
            data += struct.pack("<Q", 2) + struct.pack("<ddq", 1.0, 2.0, -1) * 2
        (home / "images.bin").write_bytes(data)
    else:
        numbers = " ".join(map(str, parameters))
        (home / "cameras.txt").write_text(f"# cameras\n3 {model} {width} {height} {numbers}\n")
        lines = ["# images, then their points"]
        for index, (values, name) in enumerate(images):
            lines += [f"{index} {' '.join(map(str, values))} 3 {name}", "" if index % 2 else "1.0 2.0 -1"]
        (home / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_poses_calibration_and_pictures(scene, tmp_path, model, binary):
    views = read_views(write(scene, tmp_path / "project", model, binary=binary))
    assert views.names == tuple(f"view{index}.png" for index in range(8))
    assert torch.allclose(views.images.flip(0), scene.over_white(), atol=1e-6)
    poses = torch.from_numpy(scene.camera_from_world).float().flip(0)
    assert torch.allclose(camera.camera_from_world(views.cameras), poses, atol=1e-5)
    wanted = torch.from_numpy(scene.matrix).float().expand(8, 3, 3)
    assert torch.allclose(camera.intrinsics(views.cameras), wanted, atol=1e-4)
    assert len(read_task(tmp_path / "project").query) == 4
    assert open_dataset(tmp_path / "project").names("test") == ["project"]


def test_distortion_is_that_of_opencv():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    world = np.concatenate([points, np.ones((50, 1))], 1)
    expected = cv2.projectPoints(world, np.zeros(3), np.zeros(3), np.eye(3), np.array(COEFFICIENTS))[0][:, 0]
    assert np.abs(distort(points, COEFFICIENTS) - expected).max() < 1e-12


def test_undistorted_pictures_are_those_of_opencv():
    rows, columns = np.mgrid[:60, :80]
    smooth = np.stack([128 + 100 * np.sin(columns / 9), 128 + 100 * np.cos(rows / 7), rows * 2.0, rows * 0 + 255.0], -1)
    picture = smooth.round().astype(np.uint8)
    matrix = np.array([[70.0, 0, 39.5], [0, 72.0, 29.5], [0, 0, 1]])
    ours = undistort(picture, matrix, COEFFICIENTS).astype(int)
    theirs = cv2.undistort(picture, matrix, np.array(COEFFICIENTS)).astype(int)
    whole = (theirs[..., 3] == 255) & (ours[..., 3] == 255)
    assert whole.mean() > 0.7
    assert np.abs(ours - theirs)[whole].max() <= 4, "OpenCV interpolates in steps of 1/32 of a pixel"


def test_distorted_views_are_read_as_those_of_pinholes(scene, tmp_path):
    """Property: pictures drawn with distortion are, after reading, those of the pinhole."""
    coefficients = (-0.2, 0.03, 0.0, 0.0)
    full = (*coefficients, 0.0, 0.0, 0.0, 0.0)
    straight = np.stack(scene.pictures)[..., 3] > 0

    class Lens(type(scene)):
        def draw(self, pose):
            rows, columns = np.mgrid[: self.size[0], : self.size[1]].astype(np.float64)
            focal, centre = self.matrix[[0, 1], [0, 1]], self.matrix[:2, 2]
            seen = ((np.stack([columns, rows], -1).reshape(-1, 2) - centre) / focal)[:, None]
            ideal = cv2.undistortPoints(seen, np.eye(3), np.array(full), R=np.eye(3), P=np.eye(3))[:, 0]
            rays = np.concatenate([ideal, np.ones((len(ideal), 1))], 1)
            rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ pose[:3, :3]
            eye = -pose[:3, :3].T @ pose[:3, 3]
            hit = (rays @ (self.centre - eye)) ** 2 - ((self.centre - eye) ** 2).sum() + self.radius**2 > 0
            flat = np.where(hit[:, None], np.array([200, 40, 40, 255]), 0).astype(np.uint8)
            return flat.reshape(*self.size, 4)

    views = read_views(write(Lens(), tmp_path / "project", "OPENCV", coefficients))
    found = views.masks.flip(0)[:, 0].numpy() > 0.5
    assert (found != straight).mean() < 0.01
    nerfstudio = scene.document(**dict(zip(("k1", "k2", "p1", "p2"), coefficients, strict=True)))
    again = read_views(Lens().write(tmp_path / "nerfstudio", nerfstudio))
    assert torch.allclose(again.images, views.images.flip(0), atol=1.5 / 255)


@pytest.mark.parametrize(
    ("model", "pictures", "given"),
    [
        ("sparse/0", "input", "."),
        ("dense/sparse", "dense/images", "."),
        ("dense", "dense/images", "dense"),
        ("distorted/sparse/0", "input", "."),
        ("colmap/sparse/0", "images", "colmap"),
        ("sparse/0", "images", "sparse/0"),
    ],
)
def test_models_and_pictures_are_found_in_their_usual_folders(scene, tmp_path, model, pictures, given):
    whole = write(scene, tmp_path / "whole")
    project = tmp_path / "project"
    (project / model).mkdir(parents=True)
    (project / pictures).parent.mkdir(parents=True, exist_ok=True)
    for path in (whole / "sparse/0").iterdir():
        path.rename(project / model / path.name)
    (project / "photographs").mkdir()
    for path in (whole / "images").iterdir():
        path.rename(project / "photographs" / path.name)
    (project / pictures).symlink_to(project / "photographs")
    assert len(read_views(project / given)) == 8


@pytest.mark.parametrize(
    ("model", "own", "other", "side"),
    [("dense/sparse", "dense/images", "images", 1), ("distorted/sparse/0", "input", "images", 2)],
)
def test_a_model_has_the_nearest_pictures_of_the_size_of_its_cameras(scene, tmp_path, model, own, other, side):
    """The originals are above the model of COLMAP's image_undistorter, and next to the results of 3DGS's convert.py."""
    project = write(scene, tmp_path)
    (project / model).parent.mkdir(parents=True)
    (project / "sparse/0").rename(project / model)
    (project / "images").rename(project / own)
    (project / other).mkdir()
    for path in (project / own).iterdir():
        Image.new("RGBA", (side * scene.size[1], side * scene.size[0])).save(project / other / path.name)
    assert torch.allclose(read_views(project).images.flip(0), scene.over_white(), atol=1e-6)


def test_the_largest_part_of_a_reconstruction_is_read(scene, tmp_path):
    project = write(scene, tmp_path / "project")
    small = project / "sparse/1"
    small.mkdir()
    (small / "cameras.txt").write_text((project / "sparse/0/cameras.txt").read_text())
    (small / "images.txt").write_text("".join((project / "sparse/0/images.txt").read_text().splitlines(True)[:3]))
    assert len(read_views(project)) == 8
    (project / "sparse/0").rename(project / "sparse/2")
    assert len(read_views(project)) == 8


def test_broken_models_are_named(scene, tmp_path):
    folder = write(scene, tmp_path / "project", binary=True)
    path = folder / "sparse/0/images.bin"
    whole = path.read_bytes()
    for length in (0, 5, 60, 100, len(whole) - 40):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match="expected a whole COLMAP model, found something else"):
            read_colmap(folder, folder)
    path.write_bytes(whole.replace(b"view3.png", b"../x3.png"))
    with pytest.raises(DataError, match="expected file names inside"):
        read_colmap(folder, folder)
    fisheye = write(scene, tmp_path / "fisheye", "OPENCV_FISHEYE", (0.1, 0, 0, 0))
    with pytest.raises(DataError, match="camera models SIMPLE_PINHOLE, .*, found OPENCV_FISHEYE; run COLMAP's"):
        read_colmap(fisheye, fisheye)
    (path.parent / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 5, 4, 4, *range(4)))
    with pytest.raises(DataError, match="camera models SIMPLE_PINHOLE, .*, found OPENCV_FISHEYE; run COLMAP's"):
        read_colmap(folder, folder)
    with pytest.raises(DataError, match="expected cameras and images, .bin or .txt, found neither"):
        read_colmap(tmp_path, tmp_path)
