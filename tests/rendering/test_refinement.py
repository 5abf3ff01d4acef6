"""Source of truth: the shape that a field fills, known in closed form: all of it is kept, and little else."""

import math

import pytest
import torch

from hyperplanes.geometry import Sphere
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.rendering.refinement import refine


def ball(radius, density=50.0):
    return lambda points: density * (points.norm(dim=-1) < radius).float()


def test_nothing_that_is_filled_is_lost_and_little_else_is_kept():
    # Source of truth: a ball, whose volume is known.
    grid = refine(full(Sphere(), 32), ball(0.5))
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    inside = points.norm(dim=1) < 0.5
    assert grid.contains(points[inside]).all()
    grown = 4 / 3 * torch.pi * (0.5 + 3 * grid.voxel) ** 3
    assert float(grid.occupied.float().mean()) * 8 < grown


def test_a_brick_of_another_length_along_each_axis_is_kept_where_it_stands():
    # Source of truth: the voxels whose centres lie in it, and those beside them.
    centre, half = torch.tensor([0.3, -0.2, 0.1]), torch.tensor([0.5, 0.3, 0.2])
    centres = full(Sphere(), 32).centres()
    start, inside = (((centres - centre).abs() < half + more).all(1).view(32, 32, 32) for more in (0.13, 0.0))
    found = refine(Occupancy(start, Sphere()), lambda points: 50.0 * ((points - centre).abs() < half).all(1).float())
    assert torch.equal(found.occupied, Occupancy(inside, Sphere()).dilated().occupied)


def test_a_refined_grid_never_grows():
    start = refine(full(Sphere(), 32), ball(0.3))
    again = refine(start, ball(0.9))
    assert not (again.occupied & ~start.occupied).any()


@pytest.mark.parametrize("side", [64, 65])
def test_a_large_grid_is_asked_coarsely_first_and_ends_the_same(side):
    # Source of truth: the direct answer, asked in every voxel of the same large grid.
    asked = []

    def density(points):
        asked.append(len(points))
        return ball(0.5)(points)

    large = refine(
        full(Sphere((0.2, 0.0, 0.0), 1.0), side), lambda points: density(points - points.new_tensor([0.2, 0, 0]))
    )
    assert sum(asked) < side**3 / 2
    direct = Occupancy(torch.zeros(side, side, side, dtype=torch.bool), Sphere((0.2, 0.0, 0.0), 1.0))
    centres = full(direct.bounds, side).centres()
    direct.occupied.view(-1)[:] = ball(0.5)(centres - centres.new_tensor([0.2, 0, 0])) > 0
    assert torch.equal(large.occupied, direct.dilated().occupied)


def test_of_the_margin_what_has_no_density_towards_the_filled_voxels_is_dropped():
    # Closed form: a ball, of which no point half a voxel deep is lost; the margin is evaluated once a voxel.
    asked = []

    def density(points):
        asked.append(len(points))
        return ball(0.5)(points)

    whole = refine(full(Sphere(), 32), density)
    before = sum(asked)
    trimmed = refine(full(Sphere(), 32), density, margin_loss=0.2)
    assert sum(asked) - 2 * before <= int(whole.occupied.sum())
    assert not (trimmed.occupied & ~whole.occupied).any()
    assert trimmed.occupied.sum() < 0.8 * whole.occupied.sum()
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    assert trimmed.contains(points[points.norm(dim=1) < 0.5 - trimmed.voxel / 2]).all()


def test_a_field_that_is_empty_leaves_nothing():
    assert not refine(full(Sphere(), 16), lambda points: points.new_zeros(len(points))).occupied.any()


@pytest.mark.parametrize("side", [16, 64])
def test_what_is_dropped_is_less_opaque_than_it_may_be_whatever_the_resolution(side):
    # Closed form: fog of density s fills the sphere; the longest ray crosses 2 r of it and is 1 - exp(-2 r s) opaque.
    grid = full(Sphere(radius=2.0), side)
    faint = -math.log(1 - 0.05) / 4
    assert not refine(grid, lambda points: points.new_full((len(points),), 0.99 * faint)).occupied.any()
    assert refine(grid, lambda points: points.new_full((len(points),), 1.01 * faint)).occupied.all()


def test_a_thing_one_voxel_thick_is_kept_wherever_it_lies_between_the_centres():
    # A tilted plate: at one end it passes through centres, at the other between them.
    grid = full(Sphere(), 32)

    def plate(points):
        return 50.0 * ((points[:, 1] - points[:, 0] / 16 - 1 / 32).abs() <= grid.voxel / 2).float()

    along = torch.linspace(-0.9, 0.9, 200)
    points = torch.stack([along, along / 16 + 1 / 32, torch.zeros(200)], -1)
    assert refine(grid, plate).contains(points).all()


def points_of(thing, count=4000):
    """Points inside a thing, by rejection."""
    points = torch.rand(200 * count, 3, generator=torch.Generator().manual_seed(3)) * 1.8 - 0.9
    inside = points[thing(points) > 0]
    assert len(inside) > 50
    return inside[:count]


def thin_plane(voxel):
    """A hard ball with wings half a voxel thick, tilted against all axes, and a tail that stands apart from them."""
    normal = torch.nn.functional.normalize(torch.tensor([0.1, 1.0, 0.06]), dim=0)

    def density(points):
        body = points.norm(dim=-1) < 0.2
        wings = ((points @ normal).abs() < 0.28 * voxel) & (points.norm(dim=-1) < 0.8)
        tail = ((points[:, 0] - 0.85).abs() < 0.28 * voxel) & (points[:, 1].abs() < 0.3) & (points[:, 2].abs() < 0.3)
        return 500.0 * (body | wings | tail).float(), 500.0 * (body | wings).float()

    return density


@pytest.mark.parametrize("side", [32, 64])
def test_hard_parts_half_a_voxel_thick_are_kept(side):
    """Brute force: every point of wings 0.56 voxels thick, which most voxel centres miss. Without masks a grid of 64
    voxels is asked coarsely first, and what is connected to the body is followed."""
    grid = full(Sphere(), side)
    density = thin_plane(grid.voxel)
    whole = (lambda points: density(points)[0]) if side == 32 else (lambda points: density(points)[1])
    once = Occupancy((whole(grid.centres()) > 0).reshape(side, side, side), grid.bounds).dilated()
    inside, asked = points_of(whole), []
    assert once.contains(inside).float().mean() < 0.95

    def counted(points):
        asked.append(len(points))
        return whole(points)

    refined = refine(grid, counted)
    assert refined.contains(inside).all()
    assert refined.occupied.float().mean() < 0.2
    assert sum(asked) < (9 if side == 32 else 1.5) * side**3


def test_solid_voxels_are_those_of_the_ball_and_haze_is_none():
    # Closed form: a ball that is opaque, in haze of half the optical depth that counts.
    grid = full(Sphere(), 32)
    haze = 0.015 / grid.voxel
    found = refine(grid, lambda points: ball(0.5)(points) + haze)
    assert found.occupied.all()
    centres = grid.centres().norm(dim=1)
    assert torch.equal(found.solid().occupied.flatten(), centres < 0.5)
