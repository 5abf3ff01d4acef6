"""Source of truth: the mirror image of a point about a plane, and where two cameras show both."""

import math

import pytest
import torch

from hyperplanes.geometry.cameras import camera_from_world, centres, intrinsics
from hyperplanes.geometry.distortion import DistortedCamera, distorted
from hyperplanes.geometry.reflections import Plane, reflected_cameras
from tests.reference_rendering import ring

SIZE = (20, 24)
TILTED = Plane((0.6, 0.0, -0.8), 0.3)


def slanted(*, lens=False):
    """Cameras whose principal point lies to one side, with a lens or with slanted pixels."""
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
