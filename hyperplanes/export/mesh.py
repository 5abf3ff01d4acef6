"""The surface of a field as a triangle mesh with coloured vertices: cut from a grid of density, compared, written.

Two things make a part of a field opaque: high density, and low density through a long way. A level of density finds the
first; `fill_hidden` the second, by what the cameras cannot see into. Walls of fog, which a field after one step of the
hypernetwork has, were holes without it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import grid_sample

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid
from hyperplanes.utilities.colour import linear_from_srgb
from hyperplanes.utilities.files import format_of, write_whole
from hyperplanes.utilities.memory import require_memory

if TYPE_CHECKING:
    import trimesh
from hyperplanes.utilities.arguments import checked

__all__ = [
    "MESH_FORMATS",
    "Agreement",
    "Surface",
    "agreement",
    "check_voxels",
    "choose_level",
    "density_grid",
    "extract_mesh",
    "fill_hidden",
    "save_mesh",
]

MESH_FORMATS = ("ply", "glb", "obj")

SILHOUETTE = 64  # pixels along the longer side of the silhouettes that surfaces are compared by
LEVEL_VIEWS = 8
LEVELS = 60
DEPTH_TOLERANCE = 0.05  # radii of the scene

HIDDEN = 0.35
"""Opacity in front of a point from which on a camera does not see it. The camera with the clearest look decides, so 0.5
leaves dents in walls of fog. Of two cars after one step, seen from seven places, 94.0 % of the pixels were as far away
as rendered, 94 % with 0.5, 90 % with 0.2, and 93 % by a level alone, which left holes; a chair that was fine-tuned for
60 steps stayed as it was (94.6 %)."""

BYTES_OF_POINT = 64  # of a grid, while its density is computed


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in world units with a colour a vertex, faces anticlockwise seen from outside.

    Attributes:
        vertices: (vertex, 3).
        faces: (face, 3) vertex indices.
        colours: (vertex, 3) sRGB in [0, 1], each as seen from straight above its place.
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int64]
    colours: npt.NDArray[np.float32]


def check_voxels(voxels: int) -> None:
    """Refuse a grid that is none, or too large for `density_grid`.

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
    """The density of a field at the corners of a grid, zero where its occupancy is empty.

    Args:
        field: asked only where its occupancy may hold something.
        voxels: points along each side of the cube around the scene; the outer ones lie on its faces.

    Returns:
        Density per world unit. `check_voxels` says how many voxels they may be.
    """
    check_voxels(voxels)
    occupancy = field.occupancy
    bounds, device = occupancy.bounds, occupancy.occupied.device
    axis = torch.linspace(-1, 1, voxels, device=device)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = grid * bounds.radius + torch.tensor(bounds.centre, device=device)
    live = occupancy.dilated().contains(points).nonzero()[:, 0]
    density = torch.zeros(len(points), device=device)
    for part in live.split(1 << 16):
        density[part] = field.density(points[part])
    return density.reshape(voxels, voxels, voxels)


@torch.no_grad()
def choose_level(field: AdaptedField, density: Float[Tensor, "x y z"], cameras: PinholeCamera) -> float:
    """The density at which the surface has most nearly the silhouettes and the depth that the field is rendered with.

    A ray meets the surface of a level where the density along it first exceeds the level, so one pass over the rays
    judges every level. A fixed level leaves holes where walls are opaque by being thick, not dense; silhouettes alone
    do not see a hole with a wall behind it.

    Args:
        field: rendered by its own sampler.
        density: of `density_grid`.
        cameras: up to eight of them are used, at 64 pixels.

    Returns:
        Density per world unit: the level with the largest product of overlap and share, as in `Agreement`, of all views
        together.

    Raises:
        ValueError: a field that is empty everywhere.
    """
    top = float(density.max())
    if not top > 0:
        raise ValueError("field: expected some density, got one that is empty everywhere; train longer, or check masks")
    small = _small_cameras(cameras, LEVEL_VIEWS)
    covered, depth = _rendered(field, small)
    bounds, levels = field.occupancy.bounds, torch.from_numpy(np.geomspace(top * 1e-4, top * 0.9, LEVELS)).float()
    right, union = torch.zeros(LEVELS), torch.zeros(LEVELS)
    for view, first in enumerate(_first_crossings(density, levels, bounds, small)):
        seen, wanted = first.isfinite(), covered[view, :, None]
        near = (first - depth[view, :, None]).abs() <= DEPTH_TOLERANCE * bounds.radius
        right += (seen & wanted & near).sum(0)
        union += (seen | wanted).sum(0)
    return float(levels[(right / union.clamp_min(1)).argmax()]) if right.any() else top / 2


@torch.no_grad()
def fill_hidden(
    density: Float[Tensor, "x y z"], level: float, bounds: Sphere, cameras: PinholeCamera
) -> Float[Tensor, "x y z"]:
    """The density, with what no camera sees into made as dense as the level and more.

    Args:
        density: of `density_grid`.
        level: at which the surface will be cut.
        bounds: the sphere that the grid's cube is around.
        cameras: all of them look; what is in none of their images stays as it is.

    Returns:
        A grid that is above the level where the density is, or where each camera that has the place in its image has
        an opacity above HIDDEN before it.
    """
    side = len(density)
    live = density.nonzero()
    if not len(live):
        return density
    low, high = (live.amin(0) - 1).clamp_min(0), (live.amax(0) + 2).clamp_max(side)
    box = tuple(slice(int(first), int(last)) for first, last in zip(low, high, strict=True))
    axis = torch.linspace(-1, 1, side, device=density.device)
    unit = torch.stack(torch.meshgrid(*(axis[part] for part in box), indexing="ij"), -1)
    points = (unit * bounds.radius + unit.new_tensor(bounds.centre)).reshape(-1, 3)
    least = points.new_full((len(points),), math.inf)
    cameras = camera.to(cameras, points.device, torch.float32)
    for view in range(cameras.batch_size):
        least = torch.minimum(least, _opacity_before(points, density, bounds, camera.select(cameras, [view])))
    hidden = torch.where(least.isfinite(), least, 0.0).reshape(unit.shape[:3])
    filled = density.clone()
    filled[box] = torch.maximum(density[box], level * (hidden / HIDDEN).clamp_max(2))
    return filled


def _opacity_before(
    points: Float[Tensor, "point 3"], density: Tensor, bounds: Sphere, cameras: PinholeCamera
) -> Float[Tensor, " point"]:
    """The opacity between one camera and each point, infinite where the point is not in its image.

    It is integrated along rays through a grid of pixels, half as fine as the density's, and interpolated between them.
    """
    height, width = camera.image_size(cameras)
    offsets = points - camera.centres(cameras)
    distances = offsets.norm(dim=-1)
    pixels = cameras.project(points[None])[0]
    inside = ((pixels > -0.5) & (pixels < pixels.new_tensor([width, height]) - 0.5)).all(-1)
    seen = (offsets @ camera.viewing_directions(cameras)[0] > 0) & inside
    if seen.sum() < 2:
        return torch.full_like(distances, math.inf)
    first, last = pixels[seen].amin(0), pixels[seen].amax(0)
    near, far = float(distances[seen].min()), float(distances[seen].max())
    side, voxel = len(density) // 2, 2 * bounds.radius / (len(density) - 1)
    through = first + pixel_grid(side, side, points.device) / (side - 1) * (last - first)
    along = torch.linspace(near, far, math.ceil((far - near) / voxel) + 2, device=points.device)
    rays = cast(cameras, torch.zeros(len(through), dtype=torch.long, device=points.device), through)
    values = []
    for part in range(0, len(rays), side):  # a row of pixels at a time
        places = bounds.normalise(rays[part : part + side].at(along.expand(side, -1)))
        values.append(grid_sample(density[None, None], places.flip(-1)[None, None], align_corners=True)[0, 0, 0])
    values = torch.cat(values)
    depth = (values.cumsum(-1) - values / 2) * ((far - near) / (len(along) - 1))
    opacity = (1 - torch.exp(-depth)).reshape(side, side, -1)
    wanted = torch.cat([((distances - near) / (far - near))[:, None], (pixels - first) / (last - first)], 1) * 2 - 1
    found = grid_sample(opacity[None, None], wanted[None, None, None], align_corners=True)[0, 0, 0, 0]
    return torch.where(seen, found, math.inf)


@dataclass(frozen=True)
class Agreement:
    """How well a surface shows what the field's pictures show.

    Attributes:
        overlap: of the silhouettes: intersection over union, mean over views.
        depth: share of the pixels that both cover at which the surface is as far away as the field is rendered, to
            `DEPTH_TOLERANCE` of the scene's radius. A hole through which the far side is seen lowers it; 0 where no
            pixel is covered by both.
    """

    overlap: float
    depth: float


@torch.no_grad()
def agreement(surface: Surface, field: AdaptedField, cameras: PinholeCamera) -> Agreement:
    """Compare a surface with the pictures of the field that it was cut from.

    Args:
        surface: rays are cast at its triangles.
        field: rendered by its own sampler; a pixel counts where it is more than half opaque.
        cameras: all of them, at 64 pixels.

    Returns:
        Both figures, from 0 to 1.
    """
    small = _small_cameras(cameras, cameras.batch_size)
    wanted, depth = _rendered(field, small)
    origins, directions = (part.reshape(-1, 3).numpy() for part in _pixel_rays(small))
    rays = _mesh(surface.vertices, surface.faces).ray
    places, ray, _ = rays.intersects_location(origins, directions, multiple_hits=False)
    first = torch.full((wanted.numel(),), math.inf)
    distances = np.linalg.norm(places - origins[ray], axis=1)
    first[torch.from_numpy(ray)] = torch.from_numpy(distances).float()
    first = first.reshape(wanted.shape)
    both, union = first.isfinite() & wanted, (first.isfinite() | wanted).sum(1)
    overlap = torch.where(union > 0, both.sum(1) / union.clamp_min(1), 1.0).mean()
    near = (first - depth)[both].abs() <= DEPTH_TOLERANCE * field.occupancy.bounds.radius
    return Agreement(float(overlap), float(near.float().mean()) if len(near) else 0.0)


@checked
@torch.no_grad()
def extract_mesh(
    field: AdaptedField,
    *,
    voxels: int = 128,
    level: float | None = None,
    density: Float[Tensor, "x y z"] | None = None,
) -> Surface:
    """The surface on which the density crosses a level, by marching cubes.

    Args:
        field: asked on a grid, only where its occupancy may hold something.
        voxels: along each side of the cube around the scene.
        level: density per world unit; where absent, what makes 1/64 of the scene's diameter half opaque. `choose_level`
            finds the one whose silhouettes and depth agree with the rendered ones.
        density: of `density_grid`, where it was computed before; `voxels` does not count then.

    Returns:
        The surface, closed at the border of the cube too.

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
    return Surface(world, faces, _colours(field, _mesh(world, faces), device))


def _small_cameras(cameras: PinholeCamera, most: int) -> PinholeCamera:
    """Some of the cameras, spread over all, at SILHOUETTE pixels along the longer side, on the CPU."""
    chosen = torch.linspace(0, cameras.batch_size - 1, min(most, cameras.batch_size)).round().long()
    cameras = camera.to(camera.select(cameras, chosen.to(cameras.extrinsics.device)), "cpu", torch.float32)
    height, width = camera.image_size(cameras)
    scale = SILHOUETTE / max(height, width)
    return camera.resized(cameras, max(1, round(height * scale)), max(1, round(width * scale)))


def _pixel_rays(cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Origins and directions (view, pixel, 3) of the rays through all pixels."""
    pixels = pixel_grid(*camera.image_size(cameras))
    rays = [
        cast(cameras, torch.full((len(pixels),), view, dtype=torch.long), pixels) for view in range(cameras.batch_size)
    ]
    return torch.stack([each.origins for each in rays]), torch.stack([each.directions for each in rays])


def _rendered(field: AdaptedField, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """What a field's pictures cover, and how far away it is along the rays; both (view, pixel), on the CPU."""
    pictures = field.render(cameras)
    return pictures.opacity.flatten(1).cpu() > 0.5, pictures.depth.flatten(1).cpu()


def _first_crossings(
    density: Tensor, levels: Tensor, bounds: Sphere, cameras: PinholeCamera
) -> Iterator[Float[Tensor, "pixel level"]]:
    """Where the density along the ray of each pixel first exceeds each level.

    The density is trilinear between the grid's points and looked at every half voxel.

    Yields:
        For each view, distances along the rays, infinite where the level is never exceeded.
    """
    origins, directions = (part.to(density.device) for part in _pixel_rays(cameras))
    start = bounds.normalise(origins)
    middle = -(start * directions).sum(-1, keepdim=True)
    along = torch.linspace(-(3**0.5), 3**0.5, 2 * len(density), device=density.device)
    for view in range(len(origins)):
        distance = middle[view] + along
        points = start[view, :, None] + distance[..., None] * directions[view, :, None]
        values = grid_sample(density[None, None], points.flip(-1)[None, None], align_corners=True)[0, 0, 0]
        wanted = levels.to(values).expand(len(values), -1).contiguous()
        index = torch.searchsorted(values.cummax(-1).values, wanted, right=True)
        distance = torch.cat([distance * bounds.radius, distance.new_full((len(distance), 1), math.inf)], 1)
        yield distance.gather(1, index).cpu()


def _mesh(vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.int64]) -> trimesh.Trimesh:
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False)


def _colours(field: AdaptedField, mesh: trimesh.Trimesh, device: torch.device) -> npt.NDArray[np.float32]:
    points = torch.tensor(np.asarray(mesh.vertices), dtype=torch.float32, device=device)
    inward = -torch.tensor(np.array(mesh.vertex_normals), dtype=torch.float32, device=device)
    parts = zip(points.split(1 << 16), inward.split(1 << 16), strict=True)
    return torch.cat([field(here, along)[0] for here, along in parts]).cpu().numpy()


@checked
def save_mesh(surface: Surface, path: str | Path) -> Path:
    """Write a surface as PLY, GLB or OBJ, vertex colours included.

    glTF wants linear colours, the other two take them as they are on the screen.

    Args:
        surface: what to write.
        path: ends in .ply, .glb or .obj.

    Returns:
        The file. Another ending is a ValueError.
    """
    path = Path(path)
    kind = format_of(path, MESH_FORMATS)
    mesh = _mesh(surface.vertices, surface.faces)
    colours = surface.colours.clip(0, 1)
    if kind == "glb":
        colours = linear_from_srgb(colours)
    opaque = np.ones((len(colours), 1))
    mesh.visual.vertex_colors = np.round(np.hstack([colours, opaque]) * 255).astype(np.uint8)  # pyright: ignore
    exported = mesh.export(file_type=kind)
    write_whole(path, exported if isinstance(exported, bytes) else str(exported).encode())
    return path
