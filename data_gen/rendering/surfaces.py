"""The input of both renderers: triangles in world coordinates, with a small material model.

Colours. Textures, vertex colours, face colours, the Kd and Ke of an MTL file and the colours of a COLLADA file are
sRGB; a glTF `baseColorFactor` and `emissiveFactor` are linear, as glTF specifies. Everything is linear in a
ShadedSurface.

Material. Lambertian plus a soft GGX highlight. There is no environment to reflect, so metal would be black: metalness
is at most MAX_METALLIC, and 0 if a file states none. Roughness is at least MIN_ROUGHNESS, and DEFAULT_ROUGHNESS if a
file states none; a texture of both is replaced by its mean. Normal and occlusion maps are not drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from data_gen.meshes.materials import (
    EMISSIVE_UV,
    LINEAR_COLOUR,
    DrawnMaterial,
    Wrap,
    linear_colours,
    linear_factor,
    pbr_of_mtl,
    texture_of,
    visual_of,
)
from hyperplanes.utilities.images.sizes import scaled_size

__all__ = [
    "COINCIDENT",
    "DEFAULT_ROUGHNESS",
    "MAX_METALLIC",
    "MAX_TEXTURE_SIDE",
    "MIN_ROUGHNESS",
    "RenderError",
    "ShadedSurface",
    "shaded_surfaces",
]

MAX_METALLIC = 0.3
"""Largest metalness that is drawn."""

MIN_ROUGHNESS = 0.35
"""Smallest roughness that is drawn."""

DEFAULT_ROUGHNESS = 0.8
"""Roughness of a material that has none."""

MAX_TEXTURE_SIDE = 2048
"""Most texels per side; larger textures are reduced."""

COINCIDENT = 1e-4
"""Largest distance, in radii of the object, at which an outer side behind an inner one counts as coincident."""

_PLAIN = (0.72, 0.72, 0.72, 1.0)

Floats = npt.NDArray[np.float64]


class RenderError(ValueError):
    """An object that cannot be drawn, or of which nothing is visible."""


@dataclass(frozen=True, eq=False)
class ShadedSurface:
    """Triangles of one material, in world axes.

    Attributes:
        positions: vertices `(vertex, 3)`.
        faces: vertex indices `(face, 3)`.
        normals: unit vertex normals `(vertex, 3)`; zero for the face's own.
        uv: texture coordinates `(vertex, 2)`, v upwards; None without textures.
        colours: linear RGBA `(vertex, 4)` that multiplies the base colour, or None.
        base_colour: linear RGBA `(4,)`.
        texture: base colour texture uint8 `(height, width, 4)`, sRGB, first row on top, PREMULTIPLIED so that
            filtering does not mix in transparent texels; None without.
        emissive: linear RGB `(3,)` that is added to the reflected light.
        emissive_texture: like texture, multiplies emissive.
        emissive_uv: its coordinates if they differ from `uv`, else None.
        wrap: wrap mode of the texture along u and along v.
        emissive_wrap: that of emissive_texture.
        roughness: in [MIN_ROUGHNESS, 1].
        metallic: in [0, MAX_METALLIC].
        cutoff: alpha below this is transparent, from it on opaque (glTF MASK); None for alpha that blends.
        opaque: whether all of it is opaque.
        unlit: whether the base colour is shown without lighting.
        two_sided: number of faces, the first ones, that are visible from both sides. Of the others only the outer side
            is: of faces of closed solids, and of faces that coincide with one of opposite winding.
        culled: whether the inner sides of its faces hide nothing, as for glTF's one-sided materials: they are drawn
            where a ray hits nothing else. Without them there would be holes in masks.
    """

    positions: Floats
    faces: npt.NDArray[np.int64]
    normals: Floats
    uv: Floats | None
    colours: Floats | None
    base_colour: Floats
    texture: npt.NDArray[np.uint8] | None
    emissive: Floats
    emissive_texture: npt.NDArray[np.uint8] | None
    emissive_uv: Floats | None
    wrap: tuple[Wrap, Wrap]
    emissive_wrap: tuple[Wrap, Wrap]
    roughness: float
    metallic: float
    cutoff: float | None
    opaque: bool
    unlit: bool
    two_sided: int
    culled: bool


def shaded_surfaces(parts: Sequence[trimesh.Trimesh], name: str = "object") -> list[ShadedSurface]:
    """Convert the parts of an object for the renderers.

    Args:
        parts: meshes in world coordinates. Shading is smooth unless `metadata["smooth"]` is false or there are face
            colours. `metadata["closed"]` marks closed meshes; inner sides of meshes with `metadata["one_sided"]` hide
            nothing.
        name: name of the object in errors.

    Returns:
        One surface per part, in order; parts without faces are left out.

    Raises:
        RenderError: if a face's vertex is not finite, a texture has no coordinates, a material is of an unknown type,
            or no part has a face.
    """
    images: dict[Any, npt.NDArray[np.uint8]] = {}
    surfaces = []
    for number, mesh in enumerate(parts):
        if len(mesh.faces):
            surfaces.append(_surface(mesh, f"{name}, part {number}", images))
    if not surfaces:
        raise RenderError(f"{name}: expected at least one face, got {len(parts)} parts without any")
    return _one_side_where_doubled(surfaces)


def _one_side_where_doubled(surfaces: list[ShadedSurface]) -> list[ShadedSurface]:
    """Surfaces whose faces that coincide with one of opposite winding come last and count as one-sided.

    Nearly every face of ShapeNet's models exists twice, often with two materials: the one that faces the camera should
    be visible. Faces are equal if their corners agree to a tenth of COINCIDENT.
    """
    if not any(surface.two_sided for surface in surfaces):
        return surfaces
    keys, turns = zip(*(_identified(surface.positions, surface.faces) for surface in surfaces), strict=True)
    key, turn = np.concatenate(keys), np.concatenate(turns)
    both = np.intersect1d(key[turn], key[~turn])
    if not len(both):
        return surfaces
    doubled = np.isin(key, both)
    result = []
    for surface, there in zip(surfaces, np.split(doubled, np.cumsum([len(each) for each in keys])[:-1]), strict=True):
        two_sided = min(int((~there).sum()), surface.two_sided)
        order = np.argsort(there, kind="stable")
        result.append(replace(surface, faces=surface.faces[order], two_sided=two_sided))
    return result


def _identified(
    positions: Floats, faces: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.bool_]]:
    """A hash of each face by the positions of its corners in any order, and its orientation."""
    cells = np.rint(positions * (10.0 / COINCIDENT)).astype(np.int64).astype(np.uint64)
    mixed = cells[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    for column in (1, 2):  # multiply and shift, so that near positions get unrelated numbers
        mixed = ((mixed ^ (mixed >> np.uint64(29))) + cells[:, column]) * np.uint64(0xBF58476D1CE4E5B9)
    mixed ^= mixed >> np.uint64(32)
    a, b, c = mixed[faces].T
    rising = (a < b).astype(np.int8) + (b < c) + (c < a)
    return a + b + c, rising == 2


def _surface(mesh: trimesh.Trimesh, where: str, images: dict[Any, Any]) -> ShadedSurface:
    faces = np.asarray(mesh.faces, dtype=np.int64)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    finite: npt.NDArray[np.bool_] = np.asarray(np.isfinite(vertices).all(axis=1))
    if not finite[faces].all():
        bad = int((~finite[faces]).any(axis=1).sum())
        raise RenderError(f"{where}: expected finite vertices, got {bad} faces on NaN or infinity")
    positions = np.where(finite[:, None], vertices, 0.0)
    visual, texture = visual_of(mesh), texture_of(mesh)
    kind = visual.kind if visual.defined else None
    material = _material(None if texture is None else texture.material, images, where)
    uv, emissive_uv = _texture_coordinates(mesh, material, where)
    colours = None
    if isinstance(visual, ColorVisuals) and kind == "vertex":
        colours = linear_colours(visual.vertex_colors)
    elif texture is not None and LINEAR_COLOUR in texture.vertex_attributes:
        colours = np.asarray(texture.vertex_attributes[LINEAR_COLOUR], dtype=np.float64)
    if mesh.metadata.get("smooth", True) and kind != "face":
        normals = _unit(np.asarray(mesh.vertex_normals, dtype=np.float64))
    else:
        corners = faces.reshape(-1)
        positions = positions[corners]
        uv = None if uv is None else uv[corners]
        emissive_uv = None if emissive_uv is None else emissive_uv[corners]
        colours = None if colours is None else colours[corners]
        if isinstance(visual, ColorVisuals) and kind == "face":
            colours = np.repeat(linear_colours(visual.face_colors), 3, axis=0)
        faces = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
        edges = positions[1::3] - positions[0::3], positions[2::3] - positions[0::3]
        normals = np.repeat(_unit(np.cross(*edges)), 3, axis=0)
    if colours is not None and texture is None:
        material["base_colour"] = np.ones(4)
        material["opaque"] = bool((colours[:, 3] >= 1.0).all())
    elif colours is not None:
        material["opaque"] &= bool((colours[:, 3] >= 1.0).all()) or material["cutoff"] is not None
    closed = bool(mesh.metadata.get("closed")) and material["opaque"] and material["cutoff"] is None
    culled = bool(mesh.metadata.get("one_sided")) and not closed
    return ShadedSurface(
        positions=positions,
        faces=faces,
        normals=normals,
        uv=uv,
        emissive_uv=emissive_uv,
        colours=colours,
        two_sided=0 if closed or culled else len(faces),
        culled=culled,
        **material,
    )


def _unit(vectors: Floats) -> Floats:
    """Unit vectors; zero for inputs without direction."""
    vectors = np.where(np.isfinite(vectors).all(axis=1, keepdims=True), vectors, 0.0)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-12)


def _texture_coordinates(
    mesh: trimesh.Trimesh, material: dict[str, Any], where: str
) -> tuple[Floats | None, Floats | None]:
    """Coordinates of the base colour texture, and those of the emissive texture if they differ."""
    if material["texture"] is None and material["emissive_texture"] is None:
        return None, None
    texture = texture_of(mesh)
    given = None if texture is None else texture.uv
    if given is None or len(given) != len(mesh.vertices):
        found = "none" if given is None else str(len(given))
        raise RenderError(
            f"{where}: expected texture coordinates for its {len(mesh.vertices)} textured vertices, got {found}"
        )
    uv = np.asarray(given, dtype=np.float64)[:, :2]
    other = None if texture is None else texture.vertex_attributes.get(EMISSIVE_UV)
    if material["emissive_texture"] is None or other is None:
        return np.where(np.isfinite(uv), uv, 0.0), None
    return np.where(np.isfinite(uv), uv, 0.0), np.asarray(other, dtype=np.float64)


def _material(material: Any, images: dict[Any, Any], where: str) -> dict[str, Any]:
    """The fields of a ShadedSurface that come from a trimesh material."""
    if isinstance(material, SimpleMaterial):
        material = pbr_of_mtl(material)
    if material is None:
        material = PBRMaterial(baseColorFactor=_PLAIN)
    if not isinstance(material, PBRMaterial):
        raise RenderError(f"{where}: expected a PBRMaterial or a SimpleMaterial, got {type(material).__name__}")
    factor = linear_factor(material)
    base = np.ones(4) if factor is None else factor
    texture = _texels(material.baseColorTexture, images, keep_alpha=material.alphaMode in {"BLEND", "MASK"})
    if material.alphaMode not in {"BLEND", "MASK"}:
        base[3] = 1.0
    glows = material.emissiveFactor is not None
    roughness, metallic = material.roughnessFactor, material.metallicFactor
    fine = material.metallicRoughnessTexture
    if fine is not None:
        mean = np.asarray(fine.convert("RGB"), dtype=np.float64).mean(axis=(0, 1)) / 255.0
        roughness = mean[1] * (1.0 if roughness is None else roughness)
        metallic = mean[2] * (1.0 if metallic is None else metallic)
    drawn = material if isinstance(material, DrawnMaterial) else DrawnMaterial()
    cutoff = None
    if material.alphaMode == "MASK":
        cutoff = 0.5 if material.alphaCutoff is None else float(material.alphaCutoff)
    return {
        "base_colour": base,
        "texture": texture,
        "emissive": np.asarray(material.emissiveFactor, dtype=np.float64)[:3] if glows else np.zeros(3),
        "emissive_texture": _texels(material.emissiveTexture, images, keep_alpha=False) if glows else None,
        "wrap": drawn.wrap,
        "emissive_wrap": drawn.emissive_wrap,
        "unlit": drawn.unlit,
        "roughness": DEFAULT_ROUGHNESS if roughness is None else float(np.clip(roughness, MIN_ROUGHNESS, 1.0)),
        "metallic": 0.0 if metallic is None else float(np.clip(metallic, 0.0, MAX_METALLIC)),
        "cutoff": cutoff,
        "opaque": material.alphaMode != "BLEND" or (base[3] >= 1.0 and _is_opaque(texture)),
    }


def _is_opaque(texture: npt.NDArray[np.uint8] | None) -> bool:
    return texture is None or bool((texture[..., 3] == 255).all())


def _texels(image: Any, images: dict[Any, Any], *, keep_alpha: bool) -> npt.NDArray[np.uint8] | None:
    """Premultiplied RGBA of a PIL image; equal images of an object share an array."""
    if image is None:
        return None
    rgba = _premultiplied(image.convert("RGBA" if keep_alpha else "RGB").convert("RGBA"))
    if max(rgba.size) > MAX_TEXTURE_SIDE:
        rgba = rgba.resize(scaled_size(rgba.size, MAX_TEXTURE_SIDE), Image.Resampling.BOX)
    key = (rgba.size, rgba.tobytes())
    return images.setdefault(key, np.asarray(rgba))


def _premultiplied(image: Image.Image) -> Image.Image:
    texels = np.asarray(image, dtype=np.uint16)
    if (texels[..., 3] == 255).all():
        return image
    colour = (texels[..., :3] * texels[..., 3:] + 127) // 255
    return Image.fromarray(np.concatenate((colour, texels[..., 3:]), axis=-1).astype(np.uint8))
