"""Triangle meshes with vertex colours from the density of a field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.geometry.rays import Rays
from hyperplanes.utilities.files.reading import format_of
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.images.colour import linear_from_srgb
from hyperplanes.utilities.machine.memory import require_memory
from hyperplanes.utilities.messages.arguments import checked

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "MESH_FORMATS",
    "Surface",
    "as_trimesh",
    "check_voxels",
    "density_grid",
    "distances_to",
    "extract_mesh",
    "save_mesh",
]

MESH_FORMATS = ("ply", "glb", "obj")

BYTES_OF_POINT = 64  # of the grid, while its density is computed


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in world units with a colour a vertex, faces anticlockwise seen from outside.

    Attributes:
        vertices: (vertex, 3).
        faces: (face, 3) vertex indices.
        colours: (vertex, 3) sRGB in [0, 1], as seen along the normal.
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int64]
    colours: npt.NDArray[np.float32]


def check_voxels(voxels: int) -> None:
    """Check the size of a grid for `density_grid`.

    Args:
        voxels: points along each side.

    Raises:
        ValueError: fewer than 8, or more than fit into memory.
    """
    if voxels < 8:
        raise ValueError(f"voxels: expected at least 8, got {voxels}")
    require_memory("voxels", voxels, BYTES_OF_POINT * voxels**3, "take fewer")


@torch.no_grad()
def density_grid(field: AdaptedField, voxels: int = 128) -> Float[Tensor, "x y z"]:
    """The density of a field at the corners of a grid, zero where its occupancy is empty and outside its sphere.

    Args:
        field: evaluated only where its occupancy is not empty.
        voxels: points along each side of the cube around the scene; the outer ones lie on its faces.

    Returns:
        Density per world unit. `check_voxels` checks the number of voxels.
    """
    check_voxels(voxels)
    occupancy = field.occupancy
    bounds, device = occupancy.bounds, occupancy.occupied.device
    axis = torch.linspace(-1, 1, voxels, device=device)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = grid * bounds.radius + torch.tensor(bounds.centre, device=device)
    inside = grid.norm(dim=1) <= 1  # rays have no samples beyond the sphere
    live = (occupancy.dilated().contains(points) & inside).nonzero()[:, 0]
    density = torch.zeros(len(points), device=device)
    for part in live.split(1 << 16):
        density[part] = field.density(points[part])
    return density.reshape(voxels, voxels, voxels)


@checked
@torch.no_grad()
def extract_mesh(
    field: AdaptedField,
    *,
    voxels: int = 128,
    level: float | None = None,
    density: Float[Tensor, "x y z"] | None = None,
) -> Surface:
    """The isosurface of the density at a level, by marching cubes.

    Args:
        field: evaluated on a grid, only where its occupancy is not empty.
        voxels: along each side of the cube around the scene.
        level: density per world unit; if absent, the one that makes 1/64 of the scene's diameter half opaque.
            `choose_level` finds the level whose silhouettes and depth agree best with the rendered ones.
        density: of `density_grid`, if it was computed before; `voxels` is then ignored.

    Returns:
        The surface, closed also at the border of the cube.

    Raises:
        ValueError: a level that is not positive or that the density never reaches; fewer than 8 voxels.
    """
    from skimage.measure import marching_cubes

    bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
    density = density_grid(field, voxels) if density is None else density
    level = level if level is not None else 32 * math.log(2) / bounds.radius
    if not 0 < level < float(density.max()):
        raise ValueError(
            f"level: expected more than 0 and less than the highest density, {float(density.max()):.3g}, "
            f"got {level:.3g}; "
            "give a lower one, or a model that was trained longer"
        )
    volume = np.pad(density.cpu().numpy(), 1)
    vertices, faces, _, _ = marching_cubes(volume, level)  # pyright: ignore[reportGeneralTypeIssues]
    unit = (vertices - 1) * (2 / (len(density) - 1)) - 1
    world = (unit * bounds.radius + np.asarray(bounds.centre)).astype(np.float32)
    faces = faces[:, ::-1].astype(np.int64)
    return Surface(world, faces, _colours(field, as_trimesh(world, faces), device))


def as_trimesh(vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.int64]) -> trimesh.Trimesh:
    """A trimesh mesh with unchanged vertices."""
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False)


def distances_to(mesh: trimesh.Trimesh, rays: Rays) -> Float[Tensor, " ray"]:
    """The distance along each ray at which it first meets a mesh; infinite where it does not.

    Args:
        mesh: in the world.
        rays: on the CPU.
    """
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    places, ray, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    distances = np.full(len(rays), np.inf, np.float32)
    distances[ray] = np.linalg.norm(places - origins[ray], axis=1)
    return torch.from_numpy(distances)


def _colours(field: AdaptedField, mesh: trimesh.Trimesh, device: torch.device) -> npt.NDArray[np.float32]:
    points = torch.tensor(np.asarray(mesh.vertices), dtype=torch.float32, device=device)
    inward = -torch.tensor(np.array(mesh.vertex_normals), dtype=torch.float32, device=device)
    parts = zip(points.split(1 << 16), inward.split(1 << 16), strict=True)
    return torch.cat([field(here, along)[0] for here, along in parts]).cpu().numpy()


@checked
def save_mesh(surface: Surface, path: str | Path) -> Path:
    """Write a surface as PLY, GLB or OBJ, vertex colours included.

    glTF stores linear colours, the other two sRGB.

    Args:
        surface: the surface to write.
        path: ends in .ply, .glb or .obj.

    Returns:
        The file. Another ending is a ValueError.
    """
    path = Path(path)
    kind = format_of(path, MESH_FORMATS)
    mesh = as_trimesh(surface.vertices, surface.faces)
    colours = surface.colours.clip(0, 1)
    if kind == "glb":
        colours = linear_from_srgb(colours)
    opaque = np.ones((len(colours), 1))
    mesh.visual.vertex_colors = np.round(np.hstack([colours, opaque]) * 255).astype(np.uint8)  # pyright: ignore
    exported = mesh.export(file_type=kind)
    write_whole(path, exported if isinstance(exported, bytes) else str(exported).encode())
    return path
