"""A field made into files: pictures, a turntable, a mesh with coloured vertices."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Renderable
from hyperplanes.colour import linear_from_srgb
from hyperplanes.files import encode_png, write_whole
from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Views

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "MESH_FORMATS",
    "TURNTABLE_FORMATS",
    "Surface",
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
def extract_mesh(field: AdaptedField, *, voxels: int = 128, level: float | None = None) -> Surface:
    """The surface on which the density crosses a level, by marching cubes.

    Args:
        field: asked on a grid, only where its occupancy may hold something.
        voxels: along each side of the cube around the scene.
        level: density per world unit; where absent, what makes 1/64 of the scene's diameter half opaque.

    Returns:
        The surface, closed at the border of the cube too.

    Raises:
        ValueError: fewer than 8 voxels, or a density that never reaches the level.
    """
    from skimage.measure import marching_cubes

    if voxels < 8:
        raise ValueError(f"voxels: expected at least 8, got {voxels}")
    occupancy = field.occupancy
    bounds, device = occupancy.bounds, occupancy.occupied.device
    level = level if level is not None else 32 * math.log(2) / bounds.radius
    axis = torch.linspace(-1, 1, voxels, device=device)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = grid * bounds.radius + torch.tensor(bounds.centre, device=device)
    live = occupancy.dilated().contains(points).nonzero()[:, 0]
    density = torch.zeros(len(points), device=device)
    for part in live.split(1 << 16):
        density[part] = field.density(points[part])
    if not float(density.max()) > level:
        raise ValueError(
            f"level: expected less than the highest density, {float(density.max()):.3g}, got {level:.3g}; "
            "give a lower one, or a model that was trained longer"
        )
    volume = np.pad(density.reshape(voxels, voxels, voxels).cpu().numpy(), 1)
    vertices, faces, _, _ = marching_cubes(volume, level)  # pyright: ignore[reportGeneralTypeIssues]
    unit = (vertices - 1) * (2 / (voxels - 1)) - 1
    world = (unit * bounds.radius + np.asarray(bounds.centre)).astype(np.float32)
    faces = faces[:, ::-1].astype(np.int64)
    return Surface(world, faces, _colours(field, _mesh(world, faces), device))


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
