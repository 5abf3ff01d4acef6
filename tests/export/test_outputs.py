"""Source of truth: a ball with known density, whose depth, normals and surface have closed forms."""

import json

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.outputs import output_frames, save_outputs
from hyperplanes.export.surfaces.points import point_cloud, save_points
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering.images import Pictures
from hyperplanes.rendering.renderer import RayMarching

RADIUS, SIZE, STEPS, DENSITY = 0.7, 40, 200, 400.0
CAMERAS = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), camera.fibonacci_sphere(8, 3.0), SIZE, SIZE)
INTO = 1 / DENSITY + 2 / STEPS
"""The largest distance of the expected depth behind the surface: a mean free path and a step."""


def ball(points, directions):
    """Red on the side of +x, blue on the other."""
    right = (points[:, :1] > 0).float()
    density = DENSITY * (points.norm(dim=-1) < RADIUS)
    return torch.cat([right, torch.zeros_like(right), 1 - right], -1), density


@pytest.fixture(scope="module")
def pictures():
    return AdaptedField(ball, full(Sphere(), 16), RayMarching(STEPS)).render(CAMERAS)


def pixels(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def test_depth_normals_and_accumulation_are_pictures(pictures, tmp_path):
    names = [f"images/{index}.png" for index in range(8)]
    outputs = ("rgb", "depth", "normals", "accumulation")
    assert len(save_outputs(outputs, pictures, CAMERAS, tmp_path, names)) == 4 * 8
    stated = json.loads((tmp_path / "depth/depth.json").read_text())
    rays = np.stack(np.meshgrid(*2 * [(np.arange(SIZE) - (SIZE - 1) / 2) / float(CAMERAS.intrinsics[0, 0, 0])]), -1)
    square = (rays**2).sum(-1) + 1
    root = 9 - square * (9 - RADIUS**2)  # z = (3 - sqrt(root)) / square on the sphere, at distance 3
    hit = root > 0.03
    expected = (3 - np.sqrt(np.where(hit, root, 0))) / square
    for view in range(8):
        depth = pixels(tmp_path / f"depth/{view}.png")
        assert depth.dtype in (np.uint16, np.int32)
        z = stated["nearest"] + (depth - 16384.0) / 49151 * (stated["farthest"] - stated["nearest"])
        behind = (z - expected)[hit] * np.sqrt(square[hit])
        assert behind.min() > -2 / STEPS
        assert np.quantile(behind, 0.95) < INTO * 1.5  # along the ray; more at grazing angles
        assert (depth[root < -0.1] == 0).all()
        covered = pixels(tmp_path / f"accumulation/{view}.png")
        assert (covered[hit] > 250).all()
        assert (covered[root < -0.1] == 0).all()
        normal = pixels(tmp_path / f"normals/{view}.png") / 255 * 2 - 1
        assert (normal[root < -0.1] == 1).all()
        pose = camera.camera_from_world(CAMERAS)[view].double().numpy()
        local = np.concatenate([rays, np.ones((SIZE, SIZE, 1))], -1) * expected[..., None]
        outwards = (local - pose[:3, 3]) @ pose[:3, :3] / RADIUS
        assert np.degrees(np.arccos(np.clip((normal * outwards).sum(-1)[hit], -1, 1))).max() < 10
    assert (pixels(tmp_path / "0.png") == output_frames("rgb", pictures, CAMERAS)[0]).all()
    assert output_frames("depth", pictures, CAMERAS).shape == (8, SIZE, SIZE, 3)


@pytest.mark.parametrize("count", [10**6, 500])
def test_a_point_cloud_is_on_the_surface(pictures, tmp_path, count):
    path = save_points(point_cloud(pictures, CAMERAS, Sphere(), count), tmp_path / "points.ply")
    cloud = trimesh.load(path)
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    points, normals = (np.stack([data[name] for name in names], -1) for names in (("x", "y", "z"), ("nx", "ny", "nz")))
    assert 250 < len(points) <= count
    distance = np.linalg.norm(points, axis=1)
    spread = 0.01 if count > 10**5 else 0.03  # the mean of the points of a cell is below the surface
    assert np.abs(distance - RADIUS).mean() < INTO + spread
    assert np.abs(distance - RADIUS).max() < 0.15
    cosine = (normals * points).sum(1) / distance
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 5
    clear = np.abs(points[:, 0]) > 0.1
    red = np.asarray(cloud.colors)[:, 0] > 128
    assert (red == (points[:, 0] > 0))[clear].all()
    corners = np.quantile(points, [0.02, 0.98], axis=0)
    assert np.abs(corners).min() > 0.5 * RADIUS, "from all sides"


def test_points_that_other_views_contradict_are_removed(pictures):
    """One view has a small wall 0.1 in front of the ball, where other views show the background."""
    depth, opacity = pictures.depth.clone(), pictures.opacity.clone()
    depth[0, 0, 12:28, 12:28] = 2.2
    spoilt = Pictures(pictures.images, opacity, depth, 0)
    kept = point_cloud(spoilt, CAMERAS, Sphere()).points.norm(dim=-1)
    assert float(kept.max()) < RADIUS + 0.06
    with pytest.raises(ValueError, match="pictures: expected opaque pixels"):
        point_cloud(Pictures(pictures.images, 0 * opacity, depth, 0), CAMERAS, Sphere())
    with pytest.raises(ValueError, match="count: expected more points, got 1, whose means"):
        point_cloud(pictures, CAMERAS, Sphere(), 1)
