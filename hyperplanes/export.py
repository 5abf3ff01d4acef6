"""A field made into files: pictures, a turntable, a mesh with coloured vertices."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
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

from hyperplanes.adaptation.base import AdaptedField, Renderable
from hyperplanes.colour import linear_from_srgb
from hyperplanes.files import encode_png, write_whole
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid
from hyperplanes.views import Views

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "MESH_FORMATS",
    "TURNTABLE_FORMATS",
    "Agreement",
    "Surface",
    "agreement",
    "choose_level",
    "density_grid",
    "encode_animation",
    "extract_mesh",
    "orbit_cameras",
    "save_images",
    "save_mesh",
    "save_turntable",
    "to_pixels",
    "upward",
]

MESH_FORMATS = ("ply", "glb", "obj")
TURNTABLE_FORMATS = ("webp", "gif")

SILHOUETTE = 64  # pixels along the longer side of the silhouettes that surfaces are compared by
LEVEL_VIEWS = 8
LEVELS = 60
DEPTH_TOLERANCE = 0.05  # radii of the scene


def to_pixels(images: Float[Tensor, "view 3 height width"]) -> npt.NDArray[np.uint8]:
    """Images in [0, 1] as 8-bit pixels (view, height, width, 3); what lies outside is clamped.

    >>> to_pixels(torch.tensor([-1.0, 0.5, 2.0]).reshape(1, 3, 1, 1)).tolist()
    [[[[0, 128, 255]]]]
    """
    return (images.detach().clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


def encode_animation(frames: npt.NDArray[np.uint8], kind: str = "webp", seconds: float = 4.0) -> bytes:
    """An animation that repeats for ever.

    Args:
        frames: (frame, height, width, 3) pixels.
        kind: "webp" or "gif".
        seconds: of one round.

    Returns:
        The file.

    Raises:
        ValueError: another kind, or no frame.
    """
    from PIL import Image

    if kind not in TURNTABLE_FORMATS:
        raise ValueError(f"kind: expected one of {', '.join(TURNTABLE_FORMATS)}, got {kind!r}")
    if not len(frames):
        raise ValueError("frames: expected at least one, got none")
    first, *others = [Image.fromarray(frame) for frame in frames]
    how = {"quality": 90, "method": 4} if kind == "webp" else {}
    buffer = io.BytesIO()
    duration = max(20, round(1000 * seconds / len(frames)))
    first.save(buffer, kind.upper(), save_all=True, append_images=others, duration=duration, loop=0, **how)
    return buffer.getvalue()


def save_images(
    images: Float[Tensor, "view 3 height width"], folder: str | Path, names: Sequence[str] = ()
) -> list[Path]:
    """Write one PNG an image.

    Args:
        images: RGB in [0, 1].
        folder: made where absent.
        names: of the files, without ending; folders in them are dropped. Numbers where absent.

    Returns:
        The files.

    Raises:
        ValueError: names that are not one an image.
    """
    if names and len(names) != len(images):
        raise ValueError(f"names: expected {len(images)}, one an image, got {len(names)}")
    stems = [Path(name).stem for name in names]
    if len(set(stems)) != len(images):
        stems = [f"{index:04d}" for index in range(len(images))]
    paths = [Path(folder) / f"{stem}.png" for stem in stems]
    for path, pixels in zip(paths, to_pixels(images), strict=True):
        write_whole(path, encode_png(pixels, small=True))
    return paths


def upward(cameras: PinholeCamera) -> tuple[float, float, float]:
    """The direction in the world that is up in most pictures; +y where they do not agree on any.

    >>> upward(camera.pinhole(torch.eye(3), torch.eye(4)[None], 2, 2))
    (-0.0, -1.0, -0.0)
    """
    mean = -camera.camera_from_world(cameras)[:, 1, :3].mean(0)
    length = float(mean.norm())
    x, y, z = (mean / length).tolist() if length > 0.1 else (0.0, 1.0, 0.0)
    return x, y, z


def orbit_cameras(
    views: Views, count: int, *, size: int | None = None, elevation: float = math.radians(20.0)
) -> PinholeCamera:
    """Cameras on a level circle around what the views show, as far away and with the same lens.

    Args:
        views: posed images of the object.
        count: how many cameras.
        size: pixels along the longer side; that of the views where absent.
        elevation: above the horizon of `upward`, in radians.

    Returns:
        A batch of cameras; the first stands where the first view does, seen from above.

    Raises:
        ValueError: no camera asked for.
    """
    if count < 1:
        raise ValueError(f"count: expected at least one camera, got {count}")
    cameras, centre = views.cameras, torch.tensor(views.bounds.centre)
    standpoints = camera.centres(cameras).cpu().float() - centre
    up = torch.tensor(upward(cameras))
    front = standpoints[0] - (standpoints[0] @ up) * up
    if float(front.norm()) < 1e-6:
        front = torch.linalg.cross(up, up.roll(1))
    front = front / front.norm()
    side = torch.linalg.cross(up, front)
    angle = torch.arange(count) * (2 * math.pi / count)
    around = angle.cos()[:, None] * front + angle.sin()[:, None] * side
    distance = float(standpoints.norm(dim=1).median())
    eyes = centre + distance * (math.cos(elevation) * around + math.sin(elevation) * up)
    x, y, z = up.tolist()
    pose = camera.look_at(eyes, views.bounds.centre, (x, y, z)).to(cameras.extrinsics)
    height, width = views.size
    batch = camera.with_poses(camera.select(cameras, [0] * count), pose)
    if size is None:
        return batch
    scale = size / max(height, width)
    return camera.resized(batch, max(1, round(height * scale)), max(1, round(width * scale)))


def save_turntable(
    field: Renderable, views: Views, path: str | Path, *, frames: int = 48, size: int | None = None
) -> Path:
    """Render one round around the object and write it as an animation.

    Args:
        field: what is seen.
        views: whose lens, distance and up are taken.
        path: ends in .webp or .gif.
        frames: of the round.
        size: pixels along the longer side; that of the views where absent.

    Returns:
        The file.

    Raises:
        ValueError: another ending.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in TURNTABLE_FORMATS:
        raise ValueError(f"{path}: expected a name that ends in {' or '.join(TURNTABLE_FORMATS)}, got {kind!r}")
    pictures = field.render(orbit_cameras(views, frames, size=size))
    write_whole(path, encode_animation(to_pixels(pictures.images), kind))
    return path


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


@torch.no_grad()
def density_grid(field: AdaptedField, voxels: int = 128) -> Float[Tensor, "x y z"]:
    """The density of a field at the corners of a grid, zero where its occupancy is empty.

    Args:
        field: asked only where its occupancy may hold something.
        voxels: points along each side of the cube around the scene; the outer ones lie on its faces.

    Returns:
        Density per world unit.

    Raises:
        ValueError: fewer than 8 voxels.
    """
    if voxels < 8:
        raise ValueError(f"voxels: expected at least 8, got {voxels}")
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
        ValueError: a density that never reaches the level; fewer than 8 voxels.
    """
    from skimage.measure import marching_cubes

    bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
    density = density_grid(field, voxels) if density is None else density
    level = level if level is not None else 32 * math.log(2) / bounds.radius
    if not float(density.max()) > level:
        raise ValueError(
            f"level: expected less than the highest density, {float(density.max()):.3g}, got {level:.3g}; "
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


def save_mesh(surface: Surface, path: str | Path) -> Path:
    """Write a surface as PLY, GLB or OBJ, vertex colours included.

    glTF wants linear colours, the other two take them as they are on the screen.

    Args:
        surface: what to write.
        path: ends in .ply, .glb or .obj.

    Returns:
        The file.

    Raises:
        ValueError: another ending.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in MESH_FORMATS:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(MESH_FORMATS)}, got {kind!r}")
    mesh = _mesh(surface.vertices, surface.faces)
    colours = surface.colours.clip(0, 1)
    if kind == "glb":
        colours = linear_from_srgb(colours)
    opaque = np.ones((len(colours), 1))
    mesh.visual.vertex_colors = np.round(np.hstack([colours, opaque]) * 255).astype(np.uint8)  # pyright: ignore
    exported = mesh.export(file_type=kind)
    write_whole(path, exported if isinstance(exported, bytes) else str(exported).encode())
    return path
