"""Source of truth: the same rays in double precision."""

import pytest
import torch

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid


@pytest.mark.parametrize("distance", [3.0, 100.0, 5000.0])
def test_rays_of_distant_cameras_intersect_the_sphere_as_in_double_precision(distance):
    field_of_view = 2.4 / distance  # radians; the sphere spans five sixths of the picture's width
    chords = []
    for dtype in (torch.float32, torch.float64):
        poses = camera.look_at(torch.tensor([[0.3, 0.5, 0.8]], dtype=torch.float64) * distance).to(dtype)
        cameras = camera.pinhole(camera.symmetric_intrinsics(32, 32, field_of_view).to(dtype), poses, 32, 32)
        rays = cast(cameras, torch.zeros(1024, dtype=torch.long), pixel_grid(32, 32).to(dtype))
        chords.append(rays.far.double() - rays.near.double())
    single, double = chords
    inside = double > 0.5  # the length of a tangent ray has a large rounding error
    assert inside.sum() > 300
    assert (single - double)[inside].abs().max() < 2e-6 * max(distance, 10)
    assert ((single > 0) != (double > 0)).float().mean() < 0.01


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, -2.0)])
def test_rays_are_transformed_so_that_a_sphere_is_the_unit_sphere(centre):
    sphere, directions = Sphere(centre, 4.0), torch.nn.functional.normalize(torch.eye(3) + 0.5, dim=1)
    torch.testing.assert_close(sphere.normalise(torch.tensor(centre) + 4 * directions), directions)


@pytest.mark.parametrize("near_far", ["sphere", "constant"])
def test_a_camera_in_the_sphere_sees_nothing_behind_itself(near_far):
    poses = camera.look_at(torch.tensor([[0.0, 0.0, 0.25]]))
    cameras = camera.pinhole(camera.symmetric_intrinsics(3, 3, 0.7), poses, 3, 3)
    rays = cast(cameras, torch.zeros(9, dtype=torch.long), pixel_grid(3, 3), near_far=near_far)
    assert torch.equal(rays.near, torch.zeros(9))
    assert float(rays.far[4]) == pytest.approx(1.25)
