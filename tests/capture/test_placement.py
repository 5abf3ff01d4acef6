"""Source of truth: worlds with a known up direction and object, seen by cameras with known orientations."""

from dataclasses import fields

import numpy as np
import pytest
import torch

from hyperplanes.capture.placement import Placement, find_up, object_points, object_sphere
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.geometry import cameras as camera

UP = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
SIZE = 100


def world_from_y_up():
    x = np.cross([0.0, 1.0, 0.0], UP)
    x /= np.linalg.norm(x)
    return np.stack([x, UP, np.cross(x, UP)], 1)


def scene(elevation=0.6, views=12, seed=0, plane=False):
    """A model of a ball of radius 0.5 around (3, 1, 2) and of far points, in a world with up UP; masks; the centre."""
    generator = np.random.default_rng(seed)
    turn, middle = world_from_y_up(), np.array([3.0, 1.0, 2.0])
    pose = camera.orbit(views, 3.0, elevation).numpy().astype(float)
    poses = pose.copy()
    poses[:, :3, :3] = pose[:, :3, :3] @ turn.T
    poses[:, :3, 3] = pose[:, :3, 3] - poses[:, :3, :3] @ middle
    ball = generator.normal(size=(400, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=-1, keepdims=True)
    around = generator.uniform(-6, 6, (300, 3))
    around = around[np.linalg.norm(around, axis=-1) > 2.5]
    if plane:
        flat = generator.uniform(-1.2, 1.2, (400, 3)) * [1, 0, 1]
        around = np.concatenate([around, flat[np.linalg.norm(flat, axis=-1) > 0.6] - [0, 0.5, 0]])
    points = np.concatenate([ball, around]) @ turn.T + middle
    calibration = np.array([[120.0, 0, 49.5], [0, 120.0, 49.5], [0, 0, 1]])
    observed = np.stack(np.meshgrid(np.arange(views), np.arange(len(points)), indexing="ij"), -1).reshape(-1, 2)
    model = SparseModel(
        np.arange(views), poses, np.tile(calibration, (views, 1, 1)), np.zeros((views, 2)), points,
        np.zeros((len(points), 3), np.uint8), np.zeros(len(points)), observed,
    )  # fmt: skip
    pixels = np.stack([model.project(view, points)[0].T for view in range(views)])
    rows, columns = np.mgrid[:SIZE, :SIZE]
    masks = []
    for view in range(views):
        (x, y), distance = model.project(view, middle[None])
        masks.append((np.hypot(columns - x, rows - y) < 1.03 * 120 * 0.5 / distance[0]).astype(float))
    seen = (pixels > 0).all(-1) & (pixels < SIZE - 1).all(-1)
    front = np.stack([model.project(view, points)[1] for view in range(views)]) > 0.1
    kept = (seen & front).reshape(-1)
    return SparseModel(
        model.pictures, model.camera_from_world, model.calibrations, model.lenses, points, model.colours, model.errors,
        observed[kept],
    ), masks, middle  # fmt: skip


def place(model, ups, masks):
    chosen = object_points(model, masks)
    sphere = object_sphere(model, chosen)
    return Placement(sphere, *find_up(model, ups, sphere, chosen))


def degrees(found, true=UP):
    return float(np.rad2deg(np.arccos(np.clip(found @ true, -1, 1))))


def test_the_sphere_contains_the_points_within_the_masks():
    model, masks, middle = scene()
    chosen = object_points(model, masks)
    assert chosen[:400].mean() > 0.95
    sphere = object_sphere(model, chosen)
    assert np.linalg.norm(np.array(sphere.centre) - middle) < 0.03
    assert 0.5 <= sphere.radius < 0.62


def test_up_is_perpendicular_to_level_horizons():
    model, masks, _ = scene(elevation=0.9)
    up, source = find_up(
        model, np.tile([0.0, -1.0, 0.0], (len(model), 1)), object_sphere(model, object_points(model, masks)),
        object_points(model, masks),
    )  # fmt: skip
    assert degrees(up) < 0.1
    assert source == "the cameras' horizon"


def test_up_is_found_if_some_cameras_are_in_portrait_orientation():
    model, masks, _ = scene()
    ups = np.tile([0.0, -1.0, 0.0], (len(model), 1))
    quarter = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # counterclockwise in the image
    model.camera_from_world[::3] = quarter @ model.camera_from_world[::3]
    ups[::3] = [-1.0, 0.0, 0.0]
    chosen = np.zeros(len(model.points), bool)
    chosen[:400] = True
    assert degrees(find_up(model, ups, object_sphere(model, chosen), chosen)[0]) < 0.1


def test_a_plane_under_the_object_determines_up_if_the_cameras_are_rolled():
    model, masks, _ = scene(plane=True)
    generator = np.random.default_rng(1)
    for view in range(len(model)):
        roll = generator.normal(0, 0.1) + 0.12
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        model.camera_from_world[view] = turn @ model.camera_from_world[view]
    placed = place(model, np.tile([0.0, -1.0, 0.0], (len(model), 1)), masks)
    assert placed.up_from == "the plane that the object stands on"
    assert degrees(placed.up) < 0.5


def test_a_placed_world_has_z_up_and_the_object_in_the_unit_sphere():
    model, masks, middle = scene()
    placed = place(model, np.tile([0.0, -1.0, 0.0], (len(model), 1)), masks)
    moved = model.moved(placed.z_up_from_world())
    radii = np.linalg.norm(moved.points[:400], axis=-1)
    assert radii.max() <= 1
    assert radii.min() > 0.8
    rotations = torch.from_numpy(moved.camera_from_world[:, :3, :3])
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, identity, rtol=0, atol=1e-6)  # poses in single precision
    for view in range(len(model)):  # a similarity transform of points and cameras changes no projection
        (before, z), (after, _) = model.project(view, model.points), moved.project(view, moved.points)
        np.testing.assert_allclose(after[:, z > 0], before[:, z > 0], rtol=1e-5, atol=1e-4)
    right = moved.camera_from_world[:, 0, :3]
    assert np.abs(right[:, 2]).max() < 1e-2


@pytest.mark.parametrize("views", [3, 12])
def test_without_masks_the_object_is_at_the_point_that_the_cameras_look_at(views):
    """The points near it are those of the ball. Without any, the radius is 0.4 of the cameras' distance, which is 3."""
    model, _, middle = scene(views=views)
    chosen = object_points(model, None)
    assert chosen[:400].mean() > 0.95
    assert not chosen[400:].any()
    sphere = object_sphere(model, chosen)
    assert np.linalg.norm(np.array(sphere.centre) - middle) < 0.03
    assert 0.5 <= sphere.radius < 0.62
    alone = object_sphere(model, np.zeros_like(chosen))
    np.testing.assert_allclose([*alone.centre, alone.radius], [*middle, 1.2], atol=1e-4)


def test_a_saved_model_is_read_back_also_from_a_file_with_another_array(tmp_path):
    """Files of earlier versions have the pixels of the observations, too."""
    model, _, _ = scene()
    model.save(tmp_path / "model.npz")
    with np.load(tmp_path / "model.npz") as arrays:
        np.savez(tmp_path / "earlier.npz", **arrays, pixels=np.zeros((len(model.observed), 2)))
    for name in ("model.npz", "earlier.npz"):
        found = SparseModel.load(tmp_path / name)
        assert all(np.array_equal(getattr(found, each.name), getattr(model, each.name)) for each in fields(SparseModel))
