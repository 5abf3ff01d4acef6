"""Source of truth: marching along each ray in a loop that tests the grid at every step."""

import math
from dataclasses import replace

import pytest
import torch

from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.rendering import RayMarching, march
from hyperplanes.rendering.sampling import marching
from hyperplanes.rendering.sampling.marching import _walk_compiled, _walk_torch
from tests.reference_rendering import camera_at, march_ray, some_rays, voxel_is_occupied

OFF_CENTRE = Sphere((0.3, -0.2, 0.1), 0.8)


def random_grid(bounds, side=6, share=0.3, seed=0):
    return Occupancy(torch.rand(side, side, side, generator=torch.Generator().manual_seed(seed)) < share, bounds)


@pytest.mark.parametrize("stop", [-0.1, 1.0, math.nan])
def test_an_invalid_transmittance_is_refused(stop):
    with pytest.raises(ValueError, match="stop: expected a transmittance from 0 to below 1"):
        RayMarching(stop=stop)


@pytest.mark.parametrize("bounds", [Sphere(), OFF_CENTRE])
def test_samples_agree_with_a_loop_over_rays(bounds):
    grid, rays = random_grid(bounds), some_rays(40)
    found = march(rays, grid, 0.07)
    occupied = grid.occupied.tolist()
    for index in range(len(rays)):
        ray = (rays.origins[index].tolist(), rays.directions[index].tolist())
        expected = march_ray(*ray, 2.0, 4.0, 0.07, 0.5, occupied, bounds.centre, bounds.radius)
        assert found.distances[found.ray == index].tolist() == pytest.approx(expected)
    assert len(found) > 100
    assert found.step == 0.07


@pytest.mark.parametrize("seed", [None, 3])
def test_samples_lie_in_occupied_voxels(seed):
    grid, rays = random_grid(OFF_CENTRE), some_rays(200)
    found = march(rays, grid, 0.05, None if seed is None else torch.Generator().manual_seed(seed))
    points = rays.origins[found.ray] + found.distances[:, None] * rays.directions[found.ray]
    occupied = grid.occupied.tolist()
    assert len(points) > 100
    assert all(voxel_is_occupied(occupied, OFF_CENTRE.centre, OFF_CENTRE.radius, p) for p in points.tolist())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_kernel_agrees_with_pytorch(dtype):
    grid, rays = random_grid(OFF_CENTRE, 9), some_rays(700)
    rays = Rays(*(each.to(dtype) for each in (rays.origins, rays.directions, rays.near, rays.far)))
    start, count = rays.near + 0.01, int(float((rays.far - rays.near).max()) / 0.03) + 1
    ray, distances = _walk_compiled(rays, start, grid, 0.03, count)
    expected_ray, expected = _walk_torch(rays, start, grid, 0.03, count)
    if dtype == torch.float64:
        assert torch.equal(ray, expected_ray)
        torch.testing.assert_close(distances, expected)
    assert abs(len(ray) - len(expected)) <= 2  # samples at a face of a voxel may differ by rounding
    assert abs(float(distances.sum() - expected.sum())) < 10


def test_the_kernel_loses_no_sample_of_few_voxels():
    """The kernel starts and ends at their bounding box. Rays along the axes hit it, miss it and touch its faces."""
    grid = Occupancy(torch.zeros(8, 8, 8, dtype=torch.bool), Sphere())
    grid.occupied[2:4, 5, 1] = grid.occupied[3, 6, 2] = True
    assert grid.box == (-0.625, 0.125, -0.875, 0.125, 0.875, -0.125)  # with a margin of half a voxel
    places = torch.cartesian_prod(*2 * [torch.arange(-19, 20, dtype=torch.float64) / 20])  # -0.5 is one of them
    origins = torch.cat([places, torch.full_like(places[:, :1], -3.0)], 1)
    origins, others = torch.cat([origins.roll(axis, 1) for axis in range(3)]), some_rays(700)
    along = torch.eye(3, dtype=torch.float64)[[2, 0, 1]].repeat_interleave(len(places), 0)
    origins = torch.cat([origins, -origins, others.origins])
    near = torch.full_like(origins[:, 0], 2.0)
    rays = Rays(origins, torch.cat([along, -along, others.directions]), near, near + 2)
    found, expected = (walk(rays, rays.near + 0.011, grid, 0.03, 67) for walk in (_walk_compiled, _walk_torch))
    assert torch.equal(found[0], expected[0])
    torch.testing.assert_close(found[1], expected[1])
    assert len(found[0]) > 1000


def test_samples_are_sorted_by_ray_and_distance():
    found = march(some_rays(50), full(Sphere(), 4), 0.1, torch.Generator().manual_seed(0))
    same = found.ray.diff() == 0
    assert same.sum() > 500
    assert set(found.ray.tolist()) == set(range(50))
    assert (found.ray.diff() >= 0).all()
    torch.testing.assert_close(found.distances.diff()[same], torch.full_like(found.distances.diff()[same], 0.1))


def straight(near, far, origin=-3.0):
    rays = len(near)
    origins, directions = torch.zeros(rays, 3), torch.zeros(rays, 3)
    origins[:, 0], directions[:, 0] = origin, 1.0
    return Rays(origins, directions, torch.tensor(near), torch.tensor(far))


def test_one_sample_in_the_middle_of_every_step():
    # from 2 to 4 by steps of 0.5: 2.25, 2.75, 3.25, 3.75
    assert march(straight([2.0], [4.0]), full(Sphere(), 2), 0.5).distances.tolist() == [2.25, 2.75, 3.25, 3.75]


def test_a_generator_shifts_each_ray_by_one_uniform_fraction_of_a_step():
    rays = straight([2.0] * 3000, [4.0] * 3000)
    found = march(rays, full(Sphere(), 2), 0.5, torch.Generator().manual_seed(0))
    first = found.distances[found.ray.diff(prepend=torch.tensor([-1])) > 0]
    offset = ((first - 2) / 0.5).sort().values
    assert (offset - (torch.arange(3000) + 0.5) / 3000).abs().max() < 2.7 / 3000**0.5
    assert torch.equal(found.distances, march(rays, full(Sphere(), 2), 0.5, torch.Generator().manual_seed(0)).distances)


def test_rays_that_miss_have_no_samples():
    grid = full(Sphere(), 4)
    assert len(march(straight([3.0, 2.0], [3.0, 2.0]), grid, 0.1)) == 0
    assert len(march(straight([], []), grid, 0.1)) == 0
    nothing = Occupancy(torch.zeros(4, 4, 4, dtype=torch.bool), Sphere())
    assert len(march(straight([2.0], [4.0]), nothing, 0.1)) == 0
    both = march(straight([3.0, 2.0, 3.0], [3.0, 4.0, 3.0]), grid, 0.5)
    assert both.ray.tolist() == [1] * 4


@pytest.mark.parametrize("beside", [0.0, -1e-9, -1e-8])
def test_the_kernel_loses_no_sample_at_a_face_of_the_grid(beside):
    """A camera that looks along the first face of the voxels, with rays next to it that rounding moves inside."""
    grid = full(Sphere(), 64)
    grid.occupied[:32] = False
    rays = cast(camera_at((0.0, 0.0, -3.0), (65, 65)), torch.zeros(65 * 65, dtype=torch.long), pixel_grid(65, 65))
    rays = replace(rays, origins=rays.origins + torch.tensor([beside, 0.0, 0.0]))
    found, expected = (walk(rays, rays.near + 0.011, grid, 0.013, 160) for walk in (_walk_compiled, _walk_torch))
    counts = [torch.bincount(each[0], minlength=65 * 65) for each in (found, expected)]
    assert (counts[0] - counts[1]).abs().max() <= 2
    assert len(expected[0]) > 10_000


@pytest.mark.parametrize("slope", [1e-38, -1e-38, math.nan, math.inf])
def test_rays_that_never_reach_the_voxels_end(slope):
    grid = full(Sphere(), 4)
    grid.occupied[:2] = False
    origins, directions = torch.tensor([[-0.5, 0.0, 3.0]]), torch.tensor([[slope, 0.0, -1.0]])
    assert len(march(Rays(origins, directions, torch.tensor([2.0]), torch.tensor([4.0])), grid, 0.1)) == 0


def test_a_ray_from_inside_has_samples_only_ahead():
    camera = camera_at((0.2, 0.0, 0.1), (3, 3), target=(1.0, 0.0, 0.0))
    rays = cast(camera, torch.zeros(9, dtype=torch.long), pixel_grid(3, 3))
    found = march(rays, full(Sphere(), 4), 0.05)
    assert (rays.near == 0).all()
    assert (found.distances > 0).all()
    assert (found.distances < rays.far[found.ray]).all()
    assert set(found.ray.tolist()) == set(range(9))


@pytest.mark.parametrize("walk", [_walk_compiled, _walk_torch])
def test_the_samples_and_the_memory_of_a_ray_do_not_depend_on_what_is_outside_of_the_cube(walk, monkeypatch):
    monkeypatch.setattr(marching, "_has_kernel", lambda _: walk is _walk_compiled)
    grid, rays = random_grid(OFF_CENTRE), some_rays(40)
    rays = replace(rays, near=torch.zeros_like(rays.near), far=torch.full_like(rays.far, 9.0))  # behind the cube
    expected = march(rays, grid, 0.07)
    for far in (100.0, 1e9, 1e300):  # all samples of the longer ones would take 100 GB and more
        found = march(replace(rays, far=torch.full_like(rays.far, far)), grid, 0.07)
        assert torch.equal(found.ray, expected.ray)
        assert torch.equal(found.distances, expected.distances)
    found = march(replace(rays, near=rays.near - 700.0), grid, 0.07)  # 10,000 steps earlier
    assert torch.equal(found.ray, expected.ray)
    torch.testing.assert_close(found.distances, expected.distances, atol=1e-9, rtol=0)


def test_samples_lie_within_the_cube_of_the_grid():
    rays = some_rays(20)
    found = march(rays, full(Sphere(), 4), 0.1)
    points = rays.origins[found.ray] + found.distances[:, None] * rays.directions[found.ray]
    assert (points.abs() <= 1).all()
    assert set(found.ray.tolist()) == set(range(20))
    beyond = rays.origins + rays.near[:, None] * rays.directions
    assert (beyond.abs() > 1).any(), "rays begin outside the cube"


def test_the_number_of_steps_of_pictures_is_limited():
    assert RayMarching(6000).for_rendering(400).steps == 1 << 14


def test_infinite_rays_and_zero_steps_are_refused_and_backward_rays_have_no_samples():
    for far in (math.inf, math.nan):
        with pytest.raises(ValueError, match="rays: expected finite near and far"):
            march(straight([2.0], [far]), full(Sphere(), 2), 0.5)
    with pytest.raises(ValueError, match=r"step: expected more than 0 and finite, got 0\.0"):
        march(straight([2.0], [4.0]), full(Sphere(), 2), 0.0)
    assert not len(march(straight([4.0, 3.0], [2.0, 3.0]), full(Sphere(), 2), 0.5))
