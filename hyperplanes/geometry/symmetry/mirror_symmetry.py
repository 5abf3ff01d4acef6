"""The vertical plane about which voxels are most nearly symmetric."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool3d

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.symmetry.reflections import Plane

__all__ = ["more_symmetric_plane", "most_symmetric_plane"]

AZIMUTHS = 45  # azimuths of normals that are tried first
OFFSETS = (-0.04, -0.02, 0.0, 0.02, 0.04)  # of planes from the middle of the voxels, in radii of the scene
MIN_AZIMUTH_DIFFERENCE = math.radians(20)  # least angle between the azimuths of refined planes
FOLLOWED = 2  # planes that are refined
COARSE_POINTS, FINE_POINTS = 3000, 12000  # most points that are reflected
COARSE_ROUNDS, FINE_ROUNDS = 5, 9  # of the search for better planes around one
INITIAL_STEP = 0.01  # first steps around a given plane, in radians and radii


@torch.no_grad()
def most_symmetric_plane(voxels: Occupancy) -> Plane:
    """The vertical plane whose reflection maps the most voxels onto occupied ones; y is up.

    Planes of all azimuths and of some offsets are compared on blocks of 2 x 2 x 2 voxels, and the best ones refined on
    the surface voxels, which a plane that is off by a fraction of a degree does not map onto each other.

    Args:
        voxels: some of them occupied.

    Returns:
        The plane, in the world.

    Raises:
        ValueError: no voxel is occupied.
    """
    if not voxels.occupied.any():
        raise ValueError("voxels: expected some that are occupied, got none")
    voxels = voxels.with_even_side()
    fine = voxels.occupied.float()
    coarse = max_pool3d(fine[None], 2)[0]
    blocks = Occupancy(coarse > 0, voxels.bounds)
    points, surface = _points_of(blocks, COARSE_POINTS), _points_of(voxels.surface(), FINE_POINTS)

    # all azimuths, and the best ones that are not neighbours
    angles = torch.arange(AZIMUTHS) * (math.pi / AZIMUTHS)
    normals = torch.stack([angles.cos(), torch.zeros_like(angles), angles.sin()], 1)
    offsets = normals @ points.mean(0).cpu()  # planes stay on the CPU, points on their device
    planes = torch.cat([torch.cat([normals, (offsets + shift)[:, None]], 1) for shift in OFFSETS])
    order = _overlap(coarse, points, planes, "nearest").argsort(descending=True).tolist()
    followed: list[Tensor] = []
    for plane in planes[order]:
        if all(abs(float(plane[:3] @ each[:3])) < math.cos(MIN_AZIMUTH_DIFFERENCE) for each in followed):
            followed.append(plane)
        if len(followed) == FOLLOWED:
            break

    # each refined, first by blocks and then by voxels
    step = math.pi / AZIMUTHS
    found = [_refined(coarse, points, each, (step / 2, 0.0, 0.02), COARSE_ROUNDS, "nearest") for each in followed]
    found = [_refined(fine, surface, each, (step / 4, 0.0, 0.01), FINE_ROUNDS, "bilinear") for each in found]
    return _in_world(max(found, key=lambda each: float(_overlap(fine, surface, each[None], "bilinear"))), voxels.bounds)


@torch.no_grad()
def more_symmetric_plane(voxels: Occupancy, plane: Plane) -> Plane:
    """A plane near a given one about which the voxels are more symmetric, slightly tilted and shifted.

    Args:
        voxels: some of them occupied.
        plane: where the search begins, in the world.

    Raises:
        ValueError: no voxel is occupied.
    """
    if not voxels.occupied.any():
        raise ValueError("voxels: expected some that are occupied, got none")
    normal = torch.tensor(plane.normal)
    through = float(normal @ torch.tensor(voxels.bounds.centre))
    start = torch.cat([normal, torch.tensor([(plane.offset - through) / voxels.bounds.radius])])
    surface = _points_of(voxels.surface(), FINE_POINTS)
    span = (INITIAL_STEP, INITIAL_STEP, INITIAL_STEP)
    return _in_world(_refined(voxels.occupied.float(), surface, start, span, FINE_ROUNDS, "bilinear"), voxels.bounds)


def _in_world(plane: Float[Tensor, 4], bounds: Sphere) -> Plane:
    """A plane in world coordinates, from those of the unit sphere."""
    x, y, z = torch.nn.functional.normalize(plane[:3].double(), dim=0).tolist()
    return Plane.of_sphere(bounds, (x, y, z), float(plane[3]))


def _points_of(voxels: Occupancy, count: int) -> Float[Tensor, "point 3"]:
    """At most `count` random points in evenly chosen voxels, one a voxel, in the coordinates of the unit sphere.

    Voxel centres would favour planes along the axes: these alone map centres onto centres, without interpolation.
    """
    centres = voxels.bounds.normalise(voxels.centres())
    centres = centres[torch.linspace(0, len(centres) - 1, min(count, len(centres))).round().long()]
    shift = torch.rand(centres.shape, generator=torch.Generator().manual_seed(0)).to(centres) - 0.5
    return centres + shift * (2 / len(voxels.occupied))


def _overlap(
    grid: Float[Tensor, "x y z"], points: Float[Tensor, "point 3"], planes: Float[Tensor, "plane 4"], mode: str
) -> Float[Tensor, " plane"]:
    """The share of points whose mirror images lie in occupied cells, for planes of a normal and an offset each."""
    planes = planes.to(points)
    normals = planes[:, :3]
    heights = normals @ points.T - planes[:, 3:]  # (plane, point)
    mirrored = points - 2 * heights[..., None] * normals[:, None]
    sampled = grid_sample(grid[None, None], mirrored.flip(-1)[None, :, :, None], mode=mode, align_corners=False)
    return sampled.mean((0, 1, 3, 4))


def _refined(
    grid: Float[Tensor, "x y z"],
    points: Float[Tensor, "point 3"],
    plane: Float[Tensor, 4],
    span: tuple[float, float, float],
    rounds: int,
    mode: str,
) -> Float[Tensor, 4]:
    """The best plane around a given one, by a pattern search that halves its steps where no neighbour is better.

    The steps are a turn of the normal about y, its tilt towards y, in radians, and a shift in radii.
    """
    steps = torch.tensor(span)
    moves = [torch.tensor([0.0, -1.0, 1.0]) if step else torch.zeros(1) for step in span]
    around = torch.cartesian_prod(*moves)
    for _ in range(rounds):
        across = torch.linalg.cross(plane[:3], torch.tensor([0.0, 1.0, 0.0]))
        across = across if float(across.norm()) > 0.1 else torch.tensor([1.0, 0.0, 0.0])  # for a horizontal plane
        across = torch.nn.functional.normalize(across, dim=0)
        up = torch.linalg.cross(across, plane[:3])
        shifts = around * steps
        normals = torch.nn.functional.normalize(plane[:3] + shifts[:, :1] * across + shifts[:, 1:2] * up, dim=1)
        near = torch.cat([normals, plane[3] + shifts[:, 2:]], 1)
        best = int(_overlap(grid, points, near, mode).argmax())  # of ties the first: the plane itself
        plane, steps = near[best], steps if best else steps / 2
    return plane
