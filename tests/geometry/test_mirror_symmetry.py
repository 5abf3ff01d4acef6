"""Source of truth: balls placed in pairs on both sides of a plane."""

import math

import pytest
import torch

from hyperplanes.geometry import Sphere
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.symmetry.mirror_symmetry import most_symmetric_plane

PAIRED = [((0.0, 0.1, 0.4), 0.3), ((0.45, 0.0, -0.3), 0.2), ((0.25, 0.45, 0.1), 0.15)]
"""Centres and radii on one side of the plane x = 0; the centre of the first ball lies in the plane."""


def body(azimuth, offset, bounds, side=64):
    """Voxels in balls and in their mirror images about a plane whose normal has this azimuth. Lengths are in radii."""
    along = torch.tensor([math.cos(azimuth), 0.0, math.sin(azimuth)])
    across = torch.tensor([-math.sin(azimuth), 0.0, math.cos(azimuth)])
    whole = full(bounds, side)
    unit = bounds.normalise(whole.centres())
    x, y, z = unit @ along - offset, unit[:, 1], unit @ across
    local = torch.stack([x.abs(), y, z], 1)
    inside = torch.stack([(local - torch.tensor(centre)).norm(dim=1) < radius for centre, radius in PAIRED]).any(0)
    return Occupancy(inside.reshape(side, side, side), bounds)


@pytest.mark.parametrize("degrees", [0.0, 31.0, 90.0, 137.3, 179.0])
@pytest.mark.parametrize("bounds", [Sphere(), Sphere((2.0, -1.0, 0.5), 3.0)])
def test_the_plane_of_symmetry_is_found_to_a_fraction_of_a_degree_and_of_a_voxel(degrees, bounds):
    offset = 0.03
    found = most_symmetric_plane(body(math.radians(degrees), offset, bounds))
    normal = torch.tensor(found.normal)
    true = torch.tensor([math.cos(math.radians(degrees)), 0.0, math.sin(math.radians(degrees))])
    facing = 1 if float(normal @ true) > 0 else -1
    assert math.degrees(math.acos(min(1.0, abs(float(normal @ true))))) < 0.4
    height = (facing * found.offset - float(true @ torch.tensor(bounds.centre))) / bounds.radius
    assert abs(height - offset) < 0.5 * (2 / 64)


def test_some_voxel_has_to_be_occupied():
    with pytest.raises(ValueError, match="expected some that are occupied"):
        most_symmetric_plane(Occupancy(torch.zeros(4, 4, 4, dtype=torch.bool), Sphere()))


def test_a_single_voxel_has_a_plane_through_it():
    one = Occupancy(torch.zeros(8, 8, 8, dtype=torch.bool), Sphere())
    one.occupied[5, 2, 6] = True
    found = most_symmetric_plane(one)
    height = float(one.centres()[0] @ torch.tensor(found.normal)) - found.offset
    assert abs(height) < 2 / 8


@pytest.mark.parametrize("side", [3, 9, 33])
def test_a_voxel_at_the_last_border_of_an_odd_grid_has_a_plane_through_it(side):
    """Blocks of 2 x 2 x 2 voxels do not cover that border."""
    one = Occupancy(torch.zeros(side, side, side, dtype=torch.bool), Sphere((0.5, 0.0, -0.2), 2.0))
    one.occupied[-1, side // 2, -1] = True
    found = most_symmetric_plane(one)
    height = float(one.centres()[0] @ torch.tensor(found.normal)) - found.offset
    assert abs(height) < one.voxel
