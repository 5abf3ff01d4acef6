"""Source of truth: exact masks of a ball that the borders of close-ups cut off."""

import numpy as np
import pytest
import torch

from hyperplanes.data.inspection.conventions import check_conventions
from hyperplanes.data.pictures.bounds import cut_off, estimate_bounds, inverted
from hyperplanes.data.pictures.posed import posed
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry import cast
from hyperplanes.geometry.rays import pixel_grid
from hyperplanes.views import Views

RADIUS, SIZE = 0.8, 64


@pytest.fixture(scope="module")
def close_ups():
    """Nine cameras that see the whole ball, and fifteen close ones that see only a part of it."""
    poses = camera.fibonacci_sphere(24, 3.5)
    poses[9:, :3, 3] *= 1.5 / 3.5
    poses = poses[torch.randperm(24, generator=torch.Generator().manual_seed(0))]
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.9), poses, SIZE, SIZE)
    masks = []
    for view in range(24):
        rays = cast(cameras, torch.full((SIZE * SIZE,), view), pixel_grid(SIZE, SIZE))
        along = (rays.origins * rays.directions).sum(-1)
        masks.append((rays.origins.square().sum(-1) - along.square() < RADIUS**2).reshape(1, SIZE, SIZE))
    return torch.stack(masks).float(), cameras


def test_the_sphere_contains_parts_that_close_ups_cut_off(close_ups):
    masks, cameras = close_ups
    from_cameras = estimate_bounds(cameras)
    assert from_cameras.radius < RADIUS  # the cameras alone give a smaller sphere
    sphere = estimate_bounds(cameras, (255 * masks).to(torch.uint8))
    reach = RADIUS + torch.tensor(sphere.centre).norm()
    assert reach < 1.05 * sphere.radius
    assert sphere.radius < 1.4 * RADIUS


def test_masks_of_the_background_are_distinguished_from_those_of_close_ups(close_ups):
    masks, _ = close_ups
    near = masks[masks.flatten(1).mean(1) > 0.8]  # these fill their pictures
    assert len(near) >= 3
    for found in (masks, near, torch.ones_like(masks), torch.zeros_like(masks), masks[:0]):
        assert not inverted(found).any()
        assert not inverted((255 * found).to(torch.uint8)).any()
    shown_whole = masks[masks.flatten(1).mean(1) < 0.5]
    assert inverted(1 - shown_whole).all()
    assert inverted((255 * (1 - shown_whole)).to(torch.uint8)).all()


def test_single_masks_of_the_background_are_found_if_the_others_show_the_object_whole(close_ups):
    masks, _ = close_ups
    whole = masks[~cut_off(masks)]
    assert len(whole) >= 3
    some = torch.tensor([1, len(whole) - 1])
    mixed = whole.clone()
    mixed[some] = 1 - mixed[some]
    assert inverted(mixed).nonzero()[:, 0].tolist() == some.tolist()
    holed = masks[masks.flatten(1).mean(1) > 0.8].clone()  # close-ups, of which one shows the background through a hole
    holed[0] = 1.0
    holed[0, :, 16:32, 16:32] = 0.0
    assert not inverted(holed).any()
    full = torch.cat([whole, torch.ones_like(whole[:1])])  # one close-up, with a single transparent pixel
    full[-1, :, 20, 20] = 0.0
    assert not inverted(full).any()


@pytest.mark.parametrize("has_alpha", [True, False])
def test_inverted_masks_are_noted_when_a_scene_is_read(has_alpha):
    picture = np.full((SIZE, SIZE, 4), 255, np.uint8)
    picture[20:40, 20:40, 3] = 0
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.9), camera.fibonacci_sphere(3, 3.5), SIZE, SIZE)
    poses, calibrations = camera.camera_from_world(cameras).double(), camera.intrinsics(cameras).double()
    options = {"has_alpha": has_alpha, "bounds": None, "names": ("a", "b", "c"), "source": "scene"}
    found = posed([picture] * 3, poses.numpy(), calibrations.numpy(), **options)
    assert any("invert them, white is the object" in note for note in found.notes) == has_alpha
    assert not any("principal point" in note for note in found.notes)
    calibrations[1, 0, 2] = 5000.0
    found = posed([picture] * 3, poses.numpy(), calibrations.numpy(), **options)
    assert any("the principal point lies outside the image: b; check cx and cy" in note for note in found.notes)


def test_correct_poses_of_close_ups_are_accepted(close_ups):
    masks, cameras = close_ups
    views = Views(1 - 0.5 * masks.expand(-1, 3, -1, -1), cameras, masks)
    assert check_conventions(views).consistent


def test_wrong_poses_of_close_ups_are_found(close_ups):
    masks, cameras = close_ups
    generator = torch.Generator().manual_seed(1)
    moved = camera.camera_from_world(cameras).clone()
    moved[:, :3, 3] += 1.0 * torch.randn(24, 3, generator=generator)
    views = Views(1 - 0.5 * masks.expand(-1, 3, -1, -1), camera.with_poses(cameras, moved), masks)
    assert not check_conventions(views).consistent


@pytest.mark.parametrize("unit", [1e-6, 1e4])
def test_bounds_scale_with_the_unit_of_length(close_ups, unit):
    """In micrometres, metres or any other unit; with cameras only, with depths, and with masks."""
    masks, cameras = close_ups
    pose = camera.camera_from_world(cameras).clone()
    pose[:, :3, 3] *= unit
    scaled = camera.with_poses(cameras, pose)
    depths = torch.tensor([[0.5, 1.0]]).expand(24, 2)  # nearer than the centre of the ball
    alpha = (masks * 255).to(torch.uint8)
    for given, depth in ((None, None), (None, depths), (alpha, None), (alpha[:9], None)):
        count = len(alpha if given is None else given)
        one = estimate_bounds(camera.select(cameras, slice(count)), given, depth)
        other = estimate_bounds(camera.select(scaled, slice(count)), given, None if depth is None else depth * unit)
        assert other.radius == pytest.approx(one.radius * unit, rel=0.02)
        assert other.centre == pytest.approx([unit * value for value in one.centre], abs=0.02 * unit)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (3.0, -40.0, 7.0)])
def test_cameras_in_one_position_look_at_the_point_a_unit_ahead(place):
    eyes = torch.tensor([place] * 4)
    ahead = torch.tensor([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    poses = torch.cat([camera.look_at(eyes[[view]], tuple((eyes + ahead)[view].tolist())) for view in range(4)])
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.9), poses, SIZE, SIZE)
    bounds = estimate_bounds(cameras)
    assert bounds.radius == 1.0
    assert bounds.centre == pytest.approx((eyes + ahead).mean(0).tolist(), abs=1e-4)
