"""Source of truth: brute force, by marching the ray of every pixel through the voxels."""

import math

import pytest
import torch

from hyperplanes.geometry.cameras import camera_from_world, look_at, pinhole, select, to, with_poses
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid
from hyperplanes.rendering import march
from hyperplanes.rendering.footprint import footprint, pixels_across
from tests.reference_rendering import camera_at, ring

OFF_CENTRE = Sphere((0.4, -0.3, 0.2), 1.5)


def blobs(side, share, bounds, seed=0):
    grid = torch.rand(side, side, side, generator=torch.Generator().manual_seed(seed)) < share
    return Occupancy(grid, bounds)


def pixels_with_samples(grid, cameras):
    """The pixels whose rays meet an occupied voxel, by marching in small steps."""
    height, width = int(cameras.height[0]), int(cameras.width[0])
    views = cameras.batch_size
    view = torch.arange(views).repeat_interleave(height * width)
    rays = cast(cameras, view, pixel_grid(height, width).repeat(views, 1), grid.bounds)
    hit = torch.zeros(len(rays), dtype=torch.bool)
    hit[march(rays, grid, grid.voxel / 7).ray] = True
    return hit.reshape(views, height, width)


def squeezed(eye, size, focal):
    """A camera with different focal lengths in x and y."""
    matrix = torch.tensor([[focal[0], 0, size[1] / 2], [0, focal[1], size[0] / 2], [0, 0, 1.0]])
    return pinhole(matrix, look_at(torch.tensor([eye])), *size)


CAMERAS = {
    "ring": ring(3, (40, 40)),
    "not square": ring(2, (24, 56)),
    "pixels not square": squeezed((0.0, 0.4, 3.0), (60, 16), (14.0, 60.0)),
    "wide and near": camera_at((0.5, 0.3, 2.2), (64, 64), angle=math.radians(110)),
    "border of a wide picture": camera_at((2.5, 1.5, 1.6), (80, 80), target=(2.5, 1.5, 0.0), angle=2.44),
    "looking past": camera_at((0.0, 0.0, 3.5), (40, 40), target=(1.2, 0.4, 0.0), angle=0.5),
    "inside": camera_at((0.1, 0.2, 0.3), (16, 16), target=(1.0, 0.0, 0.0)),
    "looking away": camera_at((0.0, 0.0, 4.0), (12, 12), target=(0.0, 0.0, 8.0)),
}


@pytest.mark.parametrize("bounds", [Sphere(), OFF_CENTRE], ids=["unit", "off centre"])
@pytest.mark.parametrize("which", CAMERAS)
@pytest.mark.parametrize("side", [4, 12])
def test_no_pixel_that_meets_an_occupied_voxel_is_missed(which, bounds, side):
    for seed, share in ((0, 0.5), (1, 3 / side**3), (2, 1.5 / side**3)):
        grid = blobs(side, share, bounds, seed)
        missed = pixels_with_samples(grid, CAMERAS[which]) & ~footprint(grid, CAMERAS[which])
        assert not missed.any(), f"{int(missed.sum())} pixels"


@pytest.mark.parametrize("which", CAMERAS)
def test_no_pixel_that_meets_a_solid_is_missed(which):
    ball = full(Sphere(), 20)
    solid = Occupancy((ball.centres().norm(dim=1) < 0.6).reshape(20, 20, 20), Sphere())
    for grid in (solid, ball):
        assert not (pixels_with_samples(grid, CAMERAS[which]) & ~footprint(grid, CAMERAS[which])).any()


def test_far_pixels_are_omitted():
    grid = torch.zeros(32, 32, 32, dtype=torch.bool)
    grid[15:17, 15:17, 15:17] = True  # 1/16 in each direction from the centre, at distance 3: about 3 of 64 pixels
    live = footprint(Occupancy(grid, Sphere()), ring(4, (64, 64)))
    assert live.shape == (4, 64, 64)
    assert (live.flatten(1).sum(1) < 0.06 * 64 * 64).all()
    assert live[:, 31:33, 31:33].all()


def test_an_empty_grid_has_no_pixels():
    assert not footprint(blobs(4, 0.0, Sphere()), ring(2)).any()


def test_a_full_grid_covers_the_picture():
    camera = camera_at((0.0, 0.0, 3.0), (32, 32), angle=0.3)  # shows 0.45 to each side
    assert footprint(full(Sphere(), 8), camera).all()


@pytest.mark.parametrize("which", CAMERAS)
def test_the_kernel_agrees_with_pytorch(which, monkeypatch):
    grid = blobs(12, 0.02, OFF_CENTRE)
    found = footprint(grid, CAMERAS[which])
    monkeypatch.setattr("hyperplanes.rendering.footprint.find_spec", lambda name: None)
    assert torch.equal(found, footprint(grid, CAMERAS[which]))


def test_a_camera_without_a_pose_sees_nothing():
    """Otherwise pixels could be written out of bounds."""
    camera = CAMERAS["ring"]
    lost = type(camera)(camera.intrinsics, torch.full_like(camera.extrinsics, math.nan), camera.height, camera.width)
    assert not footprint(blobs(12, 0.02, Sphere()), lost).any()


def test_cameras_in_double_precision():
    grid, cameras = blobs(4, 0.3, Sphere()), ring(1)
    assert torch.equal(footprint(grid, cameras), footprint(grid, to(cameras, dtype=torch.float64)))


def test_no_cameras_are_refused():
    with pytest.raises(ValueError, match="cameras"):
        pixels_across(select(ring(2), []), Sphere())


def test_cameras_that_require_gradients_give_the_same_number_without_a_warning():
    cameras = ring(2)
    free = with_poses(cameras, camera_from_world(cameras).clone().requires_grad_())
    assert pixels_across(free, Sphere()) == pixels_across(cameras, Sphere())
