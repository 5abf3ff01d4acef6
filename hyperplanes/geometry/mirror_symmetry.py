"""The vertical plane about which voxels are most nearly symmetric."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool3d

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.reflections import Plane

__all__ = ["most_symmetric_plane"]

AZIMUTHS = 45  # of normals that are tried first
OFFSETS = (-0.04, -0.02, 0.0, 0.02, 0.04)  # of planes from the middle of the voxels, in radii of the scene
APART = math.radians(20)  # between the azimuths of two planes that are followed up
FOLLOWED = 2  # of the planes
COARSE, FINE = 3000, 12000  # points that are reflected, at most
COARSE_ROUNDS, FINE_ROUNDS = 5, 9  # of the search for better planes around one


@torch.no_grad()
def most_symmetric_plane(voxels: Occupancy) -> Plane:
    """The vertical plane about which the most voxels have an occupied one as their mirror image; y is up.

    Planes of all azimuths and of some offsets are compared by blocks of 2 x 2 x 2 voxels, and the best ones refined by
    the voxels at the surface, which a plane that is a fraction of a degree off does not map onto one another.

    Args:
        voxels: some of them occupied.

    Returns:
        The plane, in the world.

    Raises:
        ValueError: no voxel is occupied.
    """
    if not voxels.occupied.any():
        raise ValueError("voxels: expected some that are occupied, got none")
    fine = voxels.occupied.float()
    coarse = max_pool3d(fine[None], 2)[0] if min(fine.shape) > 1 else fine
    blocks = Occupancy(coarse > 0, voxels.bounds)
    points, surface = _points_of(blocks, COARSE), _points_of(voxels.surface(), FINE)

    # all azimuths, and the best ones that are not neighbours
    angles = torch.arange(AZIMUTHS) * (math.pi / AZIMUTHS)
    middle = _normals(angles) @ points.mean(0)
    planes = torch.cat([torch.stack([angles, middle + offset], 1) for offset in OFFSETS])
    order = _overlap(coarse, points, planes, "nearest").argsort(descending=True).tolist()
    followed: list[Tensor] = []
    for plane in planes[order]:
        turns = [abs(float(plane[0] - each[0])) for each in followed]
        if all(min(turn, math.pi - turn) > APART for turn in turns):
            followed.append(plane)
        if len(followed) == FOLLOWED:
            break

    # each refined, first by blocks and then by voxels
    found = []
    for plane in followed:
        near = _refined(coarse, points, plane, (math.pi / AZIMUTHS / 2, 0.02), COARSE_ROUNDS, "nearest")
        near = _refined(fine, surface, near, (math.pi / AZIMUTHS / 4, 0.01), FINE_ROUNDS, "bilinear")
        found.append((float(_overlap(fine, surface, near[None], "bilinear")), near))
    angle, offset = max(found, key=lambda each: each[0])[1].tolist()
    normal = (math.cos(angle), 0.0, math.sin(angle))
    through = sum(a * b for a, b in zip(normal, voxels.bounds.centre, strict=True))
    return Plane(normal, through + offset * voxels.bounds.radius)


def _points_of(voxels: Occupancy, count: int) -> Float[Tensor, "point 3"]:
    """At most so many random points in different voxels, evenly chosen, in the unit sphere.

    Centres of voxels would be mapped onto centres, where interpolation loses nothing, by planes along the axes alone.
    """
    centres = voxels.bounds.normalise(voxels.centres())
    centres = centres[torch.linspace(0, len(centres) - 1, min(count, len(centres))).round().long()]
    shift = torch.rand(centres.shape, generator=torch.Generator().manual_seed(0)).to(centres) - 0.5
    return centres + shift * (2 / len(voxels.occupied))


def _normals(angles: Float[Tensor, " plane"]) -> Float[Tensor, "plane 3"]:
    return torch.stack([angles.cos(), torch.zeros_like(angles), angles.sin()], 1)


def _overlap(
    grid: Float[Tensor, "x y z"], points: Float[Tensor, "point 3"], planes: Float[Tensor, "plane 2"], mode: str
) -> Float[Tensor, " plane"]:
    """The share of points whose mirror images lie in occupied cells, for planes of an azimuth and an offset each."""
    normals = _normals(planes[:, 0])
    heights = normals @ points.T - planes[:, 1:]  # (plane, point)
    mirrored = points - 2 * heights[..., None] * normals[:, None]
    sampled = grid_sample(grid[None, None], mirrored.flip(-1)[None, :, :, None], mode=mode, align_corners=False)
    return sampled.mean((0, 1, 3, 4))


def _refined(
    grid: Float[Tensor, "x y z"],
    points: Float[Tensor, "point 3"],
    plane: Float[Tensor, 2],
    span: tuple[float, float],
    rounds: int,
    mode: str,
) -> Float[Tensor, 2]:
    """The best of planes around one: a pattern search, whose steps are halved where no neighbour is better."""
    steps, around = torch.tensor(span), torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0])] * 2)
    for _ in range(rounds):
        near = plane + around * steps
        best = int(_overlap(grid, points, near, mode).argmax())  # the first of equals, which is the plane itself
        plane, steps = near[best], steps if best else steps / 2
    return plane
