"""Textured meshes: simplified, unwrapped by xatlas, coloured from the support views and the field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.surfaces.mesh import Surface, distances_to
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.geometry.visibility.penalties import fading, margins
from hyperplanes.utilities.files.reading import format_of
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.views import Views

if TYPE_CHECKING:
    import trimesh

__all__ = ["TexturedSurface", "save_textured", "texture_surface"]

FACES = 10_000
TEXTURE_SIZE = 1024
DEPTH_TOLERANCE_PIXELS = 1.5  # largest distance between a texel and the surface that a view sees, in pixels
OBLIQUE = 0.2  # smallest cosine by which the tolerance is divided
COSINE_EXPONENT = 4  # exponent of the cosine between normal and view in the weights of views
OF_FIELD = 0.02  # weight of the field's own colour, beside 1 of a view along the normal
TEXEL_CHUNK = 1 << 15


@dataclass(frozen=True)
class TexturedSurface:
    """A triangle mesh in world units with a texture, faces anticlockwise seen from outside.

    Attributes:
        vertices: (vertex, 3); duplicated at seams of the texture.
        faces: (face, 3) vertex indices.
        normals: (vertex, 3) unit vectors that point outwards.
        places: (vertex, 2) texture coordinates in [0, 1]: right, and up from the lowest row.
        texture: (height, width, 3) sRGB.
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int64]
    normals: npt.NDArray[np.float32]
    places: npt.NDArray[np.float32]
    texture: npt.NDArray[np.uint8]


@torch.no_grad()
def texture_surface(
    surface: Surface, field: AdaptedField, views: Views, *, faces: int = FACES, size: int = TEXTURE_SIZE
) -> TexturedSurface:
    """The surface with a texture instead of vertex colours.

    A texel takes its colour from the views that see its place, weighted by how frontally they see it, and less near
    image borders that crop the object; where no view sees it, from the field as seen along the normal.

    Args:
        surface: of `extract_mesh`; simplified by quadric error where it has more faces.
        field: that it was extracted from.
        views: the support views.
        faces: most triangles.
        size: approximate pixels along the longer side of the texture.

    Returns:
        The mesh.
    """
    # simplification and texture coordinates
    solid = _simplified(surface, faces)
    vertices, normals = (np.array(part, np.float32) for part in (solid.vertices, solid.vertex_normals))
    origin, indices, places, height, width = _unwrapped(vertices, np.array(solid.faces, np.uint32), size)
    blank = np.zeros((height, width, 3), np.uint8)
    mesh = TexturedSurface(vertices[origin], indices.astype(np.int64), normals[origin], places, blank)
    # the point and the normal of each texel
    row, column, face, shares = _texels(mesh)
    corners = mesh.faces[face]
    points = torch.from_numpy((mesh.vertices[corners] * shares[..., None]).sum(1))
    outward = normalize(torch.from_numpy((mesh.normals[corners] * shares[..., None]).sum(1)), dim=-1)
    # weighted mean of the colours of field and views
    device = field.occupancy.occupied.device
    parts = zip(points.to(device).split(TEXEL_CHUNK), (-outward).to(device).split(TEXEL_CHUNK), strict=True)
    total = OF_FIELD * torch.cat([field(here, along)[0].cpu() for here, along in parts])
    weight = torch.full((len(points), 1), OF_FIELD)
    for seen, share in _seen(solid, points, outward, views.to("cpu", torch.float32)):
        total += share * seen
        weight += share
    texture = np.zeros((height, width, 3), np.float32)
    texture[row, column] = (total / weight).clamp(0, 1).numpy()
    return replace(mesh, texture=_spread(texture, row, column))


def _simplified(surface: Surface, faces: int) -> trimesh.Trimesh:
    import fast_simplification
    import trimesh

    vertices, triangles = surface.vertices, surface.faces
    if len(triangles) > faces:
        vertices, triangles = fast_simplification.simplify(vertices, triangles, target_count=faces)  # pyright: ignore
    return trimesh.Trimesh(vertices, triangles, process=True)


def _unwrapped(
    vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.uint32], size: int
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint32], npt.NDArray[np.float32], int, int]:
    """The original index of each new vertex, new faces, texture coordinates, and the texture's height and width."""
    import xatlas

    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = size, 2, True
    low, high = vertices.min(0), vertices.max(0)  # xatlas drops faces below a fixed area
    atlas.add_mesh((vertices - low) / max(float((high - low).max()), np.finfo(np.float32).tiny), faces)
    atlas.generate(pack_options=packing)
    origin, indices, places = atlas[0]
    return origin, indices, places.astype(np.float32), atlas.height, atlas.width


def _texels(mesh: TexturedSurface) -> tuple[npt.NDArray[np.int64], ...]:
    """The texels whose centres lie in a triangle, or on its border: row, column, face and barycentric coordinates."""
    height, width = mesh.texture.shape[:2]
    corners = mesh.places[mesh.faces].astype(np.float64) * [width, height] - 0.5  # (face, corner, 2), texel centres
    low = np.maximum(np.floor(corners.min(1)).astype(np.int64), 0)
    high = np.minimum(np.ceil(corners.max(1)).astype(np.int64), [width - 1, height - 1])
    sides = np.maximum(high - low + 1, 0)
    number = sides.prod(1)
    face = np.repeat(np.arange(len(corners)), number)
    within = np.arange(len(face)) - np.repeat(number.cumsum() - number, number)
    column = low[face, 0] + within % sides[face, 0]
    up = low[face, 1] + within // sides[face, 0]
    a, b, c = (corners[face, corner] for corner in range(3))
    here = np.stack([column, up], 1)

    def area(p: npt.NDArray[Any], q: npt.NDArray[Any], r: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])

    whole = area(a, b, c)
    flat = np.abs(whole) < 1e-9
    shares = np.stack([area(here, b, c), area(a, here, c), area(a, b, here)], 1) / np.where(flat, 1, whole)[:, None]
    inside = (shares.min(1) >= -1e-6) & ~flat
    shares = shares[inside].astype(np.float32)
    return height - 1 - up[inside], column[inside], face[inside], shares  # pyright: ignore[reportReturnType]


def _seen(
    solid: trimesh.Trimesh, points: Tensor, outward: Tensor, views: Views
) -> Iterator[tuple[Float[Tensor, "texel 3"], Float[Tensor, "texel 1"]]]:
    """Yield the colours of the points in each view, and their weights."""
    height, width = views.size
    pixels, last = pixel_grid(height, width), torch.tensor([width - 1, height - 1])
    borders = torch.zeros(len(views), 4) if views.masks is None else margins(views.masks)
    for view in range(len(views)):
        one = camera.select(views.cameras, [view])
        through = cast(views.cameras, torch.full((len(pixels),), view), pixels)
        depth = distances_to(solid, through).reshape(1, 1, height, width)
        edge = max_pool2d(depth, 3, 1, 1) + max_pool2d(-depth, 3, 1, 1)  # range of a pixel and its neighbours
        maps = torch.cat([depth, edge], 1).nan_to_num(nan=1e9, posinf=1e9)
        pixel = 1 / float(camera.intrinsics(one)[0, 0, 0])  # its side at unit distance
        offsets = camera.centres(one) - points
        distance = offsets.norm(dim=-1)
        facing = (offsets / distance[:, None] * outward).sum(-1)
        local = points @ camera.camera_from_world(one)[0, 2, :3] + camera.camera_from_world(one)[0, 2, 3]
        at = one.project(points[None])[0] / last * 2 - 1
        # in front of the camera, and not beyond what its lens shows
        shown = (local > camera.least_depth(views.cameras)) & at.isfinite().all(-1)
        at = torch.where(shown[:, None], at, 2.0)[None, None]
        first, span = grid_sample(maps, at, mode="nearest", align_corners=True)[0, :, 0]
        tolerance = DEPTH_TOLERANCE_PIXELS * pixel * distance / facing.clamp_min(OBLIQUE)
        visible = ((first - distance).abs() < tolerance) & (span < 3 * tolerance)  # and no depth edge beside it
        colour = grid_sample(views.images[view : view + 1], at, padding_mode="border", align_corners=True)[0, :, 0].T
        inner = 1 - fading(borders[[view]], at[0, 0, :, None].clamp(-1, 1), views.size)
        yield colour, facing.clamp_min(0)[:, None] ** COSINE_EXPONENT * visible[:, None] * inner


def _spread(
    texture: npt.NDArray[np.float32], row: npt.NDArray[np.int64], column: npt.NDArray[np.int64]
) -> npt.NDArray[np.uint8]:
    """Fill texels outside all triangles with the nearest colour, so that no black is interpolated at seams."""
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(texture.shape[:2], bool)
    empty[row, column] = False
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return np.round(texture[tuple(np.asarray(nearest))] * 255).astype(np.uint8)


@checked
def save_textured(mesh: TexturedSurface, path: str | Path) -> Path:
    """Write a textured surface as GLB with normals and an unlit material, which viewers show as photographed.

    Viewers without support for unlit materials see a matte, non-metallic one.

    Args:
        mesh: the mesh to write.
        path: ends in .glb.

    Returns:
        The file. Another ending is a ValueError.
    """
    import trimesh
    from PIL import Image
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    path = Path(path)
    format_of(path, ("glb",))
    material = PBRMaterial(baseColorTexture=Image.fromarray(mesh.texture), metallicFactor=0.0, roughnessFactor=1.0)
    visual = TextureVisuals(uv=mesh.places, material=material)
    solid = trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=mesh.normals, visual=visual, process=False, validate=False
    )

    def unlit(tree: dict[str, Any]) -> None:
        tree["materials"][0]["extensions"] = {"KHR_materials_unlit": {}}
        tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), "KHR_materials_unlit"})

    write_whole(path, export_glb(trimesh.Scene(solid), include_normals=True, tree_postprocessor=unlit))
    return path
