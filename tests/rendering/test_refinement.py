"""Source of truth: fields with known shapes, which must be kept entirely and with few other voxels."""

import math

import pytest
import torch

from hyperplanes.geometry import Sphere
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.rendering.refinement import refine


def ball(radius, density=50.0):
    return lambda points: density * (points.norm(dim=-1) < radius).float()


def test_all_of_a_ball_is_kept_and_few_other_voxels():
    # Source of truth: a ball, whose volume is known.
    grid = refine(full(Sphere(), 32), ball(0.5))
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    inside = points.norm(dim=1) < 0.5
    assert grid.contains(points[inside]).all()
    grown = 4 / 3 * torch.pi * (0.5 + 3 * grid.voxel) ** 3
    assert float(grid.occupied.float().mean()) * 8 < grown


def test_a_cuboid_is_kept_at_its_place():
    # Source of truth: the voxels whose centres are inside it, and their neighbours.
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
def test_a_large_grid_is_evaluated_coarsely_first_with_the_same_result(side):
    # Source of truth: evaluating every voxel of the large grid.
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


def test_margin_voxels_without_density_near_filled_voxels_are_removed():
    # Closed form: no point of a ball deeper than half a voxel is lost; each margin voxel is evaluated once.
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


def test_an_empty_field_has_no_voxels():
    assert not refine(full(Sphere(), 16), lambda points: points.new_zeros(len(points))).occupied.any()


@pytest.mark.parametrize("side", [16, 64])
def test_the_opacity_of_removed_density_is_bounded_at_any_resolution(side):
    # Closed form: with density s in the whole sphere, the longest ray has the opacity 1 - exp(-2 r s).
    grid = full(Sphere(radius=2.0), side)
    faint = -math.log(1 - 0.05) / 4
    assert not refine(grid, lambda points: points.new_full((len(points),), 0.99 * faint)).occupied.any()
    assert refine(grid, lambda points: points.new_full((len(points),), 1.01 * faint)).occupied.all()


def test_a_plate_one_voxel_thick_is_kept_at_any_offset_from_the_centres():
    # A tilted plate: at one end it passes through centres, at the other between them.
    grid = full(Sphere(), 32)

    def plate(points):
        return 50.0 * ((points[:, 1] - points[:, 0] / 16 - 1 / 32).abs() <= grid.voxel / 2).float()

    along = torch.linspace(-0.9, 0.9, 200)
    points = torch.stack([along, along / 16 + 1 / 32, torch.zeros(200)], -1)
    assert refine(grid, plate).contains(points).all()


def points_of(thing, count=4000):
    """Points inside a shape, by rejection sampling."""
    points = torch.rand(200 * count, 3, generator=torch.Generator().manual_seed(3)) * 1.8 - 0.9
    inside = points[thing(points) > 0]
    assert len(inside) > 50
    return inside[:count]


def thin_plane(voxel):
    """A ball with wings half a voxel thick, tilted relative to all axes, and a separate tail; without the tail, too."""
    normal = torch.nn.functional.normalize(torch.tensor([0.1, 1.0, 0.06]), dim=0)

    def density(points):
        body = points.norm(dim=-1) < 0.2
        wings = ((points @ normal).abs() < 0.28 * voxel) & (points.norm(dim=-1) < 0.8)
        tail = ((points[:, 0] - 0.85).abs() < 0.28 * voxel) & (points[:, 1].abs() < 0.3) & (points[:, 2].abs() < 0.3)
        return 500.0 * (body | wings | tail).float(), 500.0 * (body | wings).float()

    return density


@pytest.mark.parametrize("side", [32, 64])
def test_hard_parts_half_a_voxel_thick_are_kept(side):
    """Brute force: all points of wings 0.56 voxels thick, which most voxel centres miss.

    A grid of 64 voxels without masks is first evaluated coarsely; parts connected to the body are then followed.
    """
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


def test_solid_voxels_are_those_of_the_ball_without_the_haze():
    # Closed form: an opaque ball in haze with half of the optical depth of the threshold.
    grid = full(Sphere(), 32)
    haze = 0.015 / grid.voxel
    found = refine(grid, lambda points: ball(0.5)(points) + haze)
    assert found.occupied.all()
    centres = grid.centres().norm(dim=1)
    assert torch.equal(found.solid().occupied.flatten(), centres < 0.5)
