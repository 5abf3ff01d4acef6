"""Source of truth: the mirror image of a point about a plane, and the pixels of both in two cameras."""

import math

import pytest
import torch

from hyperplanes.geometry.cameras import camera_from_world, centres, intrinsics, with_poses
from hyperplanes.geometry.distortion import DistortedCamera, distorted
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry, reflected_cameras
from tests.reference_rendering import ring

SIZE = (20, 24)
TILTED = Plane((0.6, 0.0, -0.8), 0.3)


def slanted(*, lens=False):
    """Cameras whose principal point is not central, with a lens or with skew."""
    cameras = ring(4, SIZE)
    cameras.intrinsics[:, 0, 2] = 8.0
    if lens:
        return distorted(cameras, torch.tensor([0.1, -0.05, 0.02, -0.03, 0.01]))
    cameras.intrinsics[:, 0, 1] = 0.7
    return cameras


@pytest.mark.parametrize("lens", [False, True])
def test_a_reflected_camera_shows_the_mirror_image_of_a_point_in_the_flipped_column(lens):
    cameras = slanted(lens=lens)
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    mirrored = (torch.cat([points.double(), torch.ones(30, 1).double()], 1) @ TILTED.reflection.T)[:, :3].float()
    seen = cameras.project(points.expand(4, -1, -1))
    found = reflected_cameras(cameras, TILTED).project(mirrored.expand(4, -1, -1))
    torch.testing.assert_close(found[..., 0], SIZE[1] - 1 - seen[..., 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(found[..., 1], seen[..., 1], atol=1e-4, rtol=0)


@pytest.mark.parametrize("lens", [False, True])
def test_a_camera_reflected_twice_is_itself(lens):
    cameras = slanted(lens=lens)
    again = reflected_cameras(reflected_cameras(cameras, TILTED), TILTED)
    torch.testing.assert_close(camera_from_world(again), camera_from_world(cameras), atol=1e-5, rtol=0)
    torch.testing.assert_close(intrinsics(again), intrinsics(cameras))
    assert isinstance(again, DistortedCamera) == lens
    if lens:
        torch.testing.assert_close(again.distortion, cameras.distortion)


def test_points_of_the_plane_stay_and_others_change_sides():
    cameras = ring(3, SIZE)
    normal = torch.tensor(TILTED.normal)
    heights = centres(cameras) @ normal - TILTED.offset
    torch.testing.assert_close(centres(reflected_cameras(cameras, TILTED)) @ normal - TILTED.offset, -heights)


@pytest.mark.parametrize("plane", [((1.0, 1.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 0.0), ((1.0, 0.0, 0.0), math.nan)])
def test_a_plane_has_a_normal_of_length_1_and_a_finite_offset(plane):
    with pytest.raises(ValueError, match="plane: expected a normal of length 1"):
        Plane(*plane)


def test_the_rotations_and_reflections_of_a_symmetry_are_a_group():
    """The product of any two of the rotations and reflections is one of them."""
    symmetry = Symmetry(TILTED, 3, (0.5, 7.0, 0.0))
    rotations = symmetry.rotations
    torch.testing.assert_close(rotations[0], torch.eye(4).double())
    assert len(rotations) == 3
    group = torch.stack([*rotations, *(rotation @ TILTED.reflection for rotation in rotations)])
    assert symmetry.images == len(group)
    products = (group[:, None] @ group).flatten(0, 1)
    apart = (products[:, None] - group).abs().amax((2, 3))
    assert apart.amin(1).max() < 1e-12
    on_axis = torch.tensor([0.5, -3.0, 0.0, 1.0]).double()
    torch.testing.assert_close(group @ on_axis, on_axis.expand(6, 4))


def test_a_quarter_turn_maps_the_z_axis_to_the_x_axis():
    turned = Symmetry(Plane((1.0, 0.0, 0.0)), 4).rotations[1] @ torch.tensor([0.0, 0.0, 1.0, 1.0]).double()
    torch.testing.assert_close(turned, torch.tensor([1.0, 0.0, 0.0, 1.0]).double())


@pytest.mark.parametrize(
    ("plane", "order", "message"),
    [
        (Plane((1.0, 0.0, 0.0)), 0, "order: expected a whole number from 1 to 64"),
        (Plane((0.0, 1.0, 0.0)), 2, "symmetry: expected a vertical plane through the axis"),
        (Plane((1.0, 0.0, 0.0), 0.1), 2, "symmetry: expected a vertical plane through the axis"),
    ],
)
def test_several_planes_have_to_be_vertical_and_contain_the_axis(plane, order, message):
    with pytest.raises(ValueError, match=message):
        Symmetry(plane, order)


def test_reflections_have_gradients_of_the_poses():
    cameras = ring(3, SIZE)
    pose = camera_from_world(cameras).clone().requires_grad_()
    cameras = with_poses(cameras, pose)
    normal = torch.tensor(TILTED.normal)
    heights = [(centres(each) @ normal).sum() for each in (cameras, reflected_cameras(cameras, TILTED))]
    own, reflected = (torch.autograd.grad(each, pose, retain_graph=True)[0] for each in heights)
    assert own[:, :3, 3].abs().sum() > 0.1
    # if a camera moves towards the plane, its mirror image moves towards it from the opposite side
    torch.testing.assert_close(reflected[:, :3, 3], -own[:, :3, 3], atol=1e-5, rtol=0)
