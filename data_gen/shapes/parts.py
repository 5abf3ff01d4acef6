"""Painted solids, and scenes made of them.

All parts of one finish are ONE geometry, and all geometries share ONE texture: a draw call costs a renderer more than
the faces of a wheel. The texture is an atlas. A plain colour is a block of it, read at the block's centre by all
corners of a face, so nothing bleeds in at any distance; a pattern is a tile with its border repeated outwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from PIL import Image
from trimesh.grouping import unique_rows
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from data_gen.shapes.materials import Material
from data_gen.shapes.solids import Solid

__all__ = ["Finish", "Part", "atlas", "build_scene", "corner_normals", "pair"]

_WIDTH, _BLOCK, _MARGIN = 256, 16, 8


@dataclass(frozen=True)
class Finish:
    """How a surface reflects, as glTF describes it.

    Attributes:
        roughness: in [0, 1].
        metallic: in [0, 1].
    """

    roughness: float = 0.55
    metallic: float = 0.0


@dataclass(frozen=True)
class Part:
    """A solid with a material on each face.

    Attributes:
        name: such as "wheel" or "left_wing".
        solid: the geometry, in the object's frame.
        materials: the materials used.
        chosen: (F,) index into `materials` of each face.
        finish: how the whole part reflects.
    """

    name: str
    solid: Solid
    materials: tuple[Material, ...]
    chosen: np.ndarray
    finish: Finish = Finish()

    @staticmethod
    def of(name: str, solid: Solid, material: Material) -> Part:
        """A solid in one material."""
        return Part(name, solid, (material,), np.zeros(len(solid.faces), dtype=np.int64))

    def painted(self, faces: np.ndarray, material: Material) -> Part:
        """The part with another material on the faces of a boolean mask (F,)."""
        chosen = np.where(faces, len(self.materials), self.chosen)
        return replace(self, materials=(*self.materials, material), chosen=chosen)

    def capped(self, material: Material, first: bool = True, last: bool = True) -> Part:
        """The part with another material on its flat ends."""
        cells = self.solid.cells
        return self.painted((cells[:, 0] == -1) & np.where(cells[:, 1] == 0, first, last), material)

    def mirrored(self) -> Part:
        """The part reflected in the plane x = 0, with "left" in its name replaced by "right"."""
        return replace(self, name=self.name.replace("left", "right"), solid=self.solid.mirrored())


def pair(*parts: Part) -> list[Part]:
    """The parts, all of them "left" ones, and their mirror images."""
    return [*parts, *(part.mirrored() for part in parts)]


def atlas(materials: Sequence[Material]) -> tuple[np.ndarray, np.ndarray]:
    """Pack materials into one image.

    Args:
        materials: plain ones (one pixel) and patterned ones, each at most 240 pixels wide.

    Returns:
        The image (H, 256, 3), uint8, and for each material the affine map (2, 2) of its uv into the image's: rows
        (scale, offset) for u and v, with v = 0 at the image's lower edge.
    """
    places, x, y, row = [], 0, 0, 0
    for material in materials:
        height, width = material.image.shape[:2]
        size = (_BLOCK, _BLOCK) if height * width == 1 else (height + 2 * _MARGIN, width + 2 * _MARGIN)
        if x + size[1] > _WIDTH:
            x, y, row = 0, y + row, 0
        places.append((y, x, *size))
        x, row = x + size[1], max(row, size[0])
    total = y + row
    image = np.full((total, _WIDTH, 3), 128, dtype=np.uint8)
    maps = np.zeros((len(materials), 2, 2))
    for material, (y, x, height, width), mapping in zip(materials, places, maps, strict=True):
        inside = material.image.shape[:2]
        before = (height - inside[0]) // 2, (width - inside[1]) // 2
        after = height - inside[0] - before[0], width - inside[1] - before[1]
        padding = ((before[0], after[0]), (before[1], after[1]), (0, 0))
        image[y : y + height, x : x + width] = np.pad(material.image, padding, mode="edge")
        if inside == (1, 1):
            mapping[:] = [(0, (x + width / 2) / _WIDTH), (0, 1 - (y + height / 2) / total)]
        else:  # from the centre of the first pixel to that of the last
            left, bottom = x + before[1] + 0.5, total - (y + before[0] + inside[0]) + 0.5
            mapping[:] = [((inside[1] - 1) / _WIDTH, left / _WIDTH), ((inside[0] - 1) / total, bottom / total)]
    return image, maps


def corner_normals(solids: Sequence[Solid]) -> np.ndarray:
    """Shading normals (F, 3, 3) of the corners of all faces of several solids, which share no vertex.

    A corner takes the area-weighted mean of the faces around its vertex whose normals are within `solid.crease`
    degrees of its own face's. All solids are processed at once: many small arrays would take longer.
    """
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    vertices = np.concatenate([solid.vertices for solid in solids])
    faces = np.concatenate([solid.faces + start for solid, start in zip(solids, starts, strict=False)])
    limit = np.repeat([np.cos(np.radians(solid.crease)) for solid in solids], [len(solid.faces) for solid in solids])
    triangles = vertices[faces]
    weighted = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-30)
    flat = faces.reshape(-1)
    around = np.argsort(flat, kind="stable")  # corners by their vertex
    count = np.bincount(flat, minlength=len(vertices))
    first = np.cumsum(count) - count
    # Every pair of corners at one vertex: a corner, and a face that may contribute to its normal.
    pairs = count[flat]
    corner = np.repeat(np.arange(len(flat)), pairs)
    turn = np.arange(len(corner)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    own, near = corner // 3, around[first[flat[corner]] + turn] // 3
    alike = (np.einsum("pk,pk->p", unit[near], unit[own]) > limit[own]) | (near == own)
    corner, near = corner[alike], near[alike]
    total = np.stack([np.bincount(corner, weighted[near, axis], len(flat)) for axis in range(3)], axis=1)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return total.reshape(-1, 3, 3)


def build_scene(name: str, parts: Sequence[Part]) -> trimesh.Scene:
    """Join parts into a scene with one textured geometry per finish.

    Args:
        name: name of the first geometry; the others have a number after it.
        parts: the painted solids.

    Returns:
        The scene. Vertices are rounded to a millionth of a unit and split where shading or texture is discontinuous;
        a geometry's `metadata["parts"]` lists (part name, first face, number of faces).
    """
    materials: dict[bytes, Material] = {}
    for part in parts:
        for index in np.unique(part.chosen):
            materials.setdefault(_key(part.materials[index]), part.materials[index])
    keys = sorted(materials, key=lambda key: materials[key].image.size == 3)  # patterns first, then the palette
    image, maps = atlas([materials[key] for key in keys])
    rows = {key: row for row, key in enumerate(keys)}
    texture = Image.fromarray(image)
    scene = trimesh.Scene()
    for number, finish in enumerate(dict.fromkeys(part.finish for part in parts)):
        label = f"{name}_{number}" if number else name
        material = PBRMaterial(
            name=label,
            baseColorTexture=texture,
            metallicFactor=finish.metallic,
            roughnessFactor=finish.roughness,
        )
        alike = [part for part in parts if part.finish == finish]
        scene.add_geometry(_joined(alike, rows, maps, material), node_name=label, geom_name=label)
    return scene


def _key(material: Material) -> bytes:
    """A key that is equal for two materials if and only if they look the same."""
    return repr(material.image.shape).encode() + material.image.tobytes()


def _joined(
    parts: Sequence[Part], rows: Mapping[bytes, int], maps: np.ndarray, material: PBRMaterial
) -> trimesh.Trimesh:
    """Parts as one mesh, their texture coordinates mapped into the atlas."""
    positions, coordinates, names, first = [], [], [], 0
    for part in parts:
        solid = part.solid
        row = np.array([rows.get(_key(each), 0) for each in part.materials])  # 0 if no face uses it
        mapping = maps[row[part.chosen]]  # (F, 2, 2)
        coordinates.append(solid.uv * mapping[:, None, :, 0] + mapping[:, None, :, 1])
        positions.append(solid.vertices[solid.faces])
        names.append((part.name, first, len(solid.faces)))
        first += len(solid.faces)
    columns = np.concatenate(positions), corner_normals([part.solid for part in parts]), np.concatenate(coordinates)
    corners = np.concatenate([column.reshape(3 * first, -1) for column in columns], axis=1)
    millionths = np.rint(corners * 1e6).astype(np.int64)
    distinct, inverse = unique_rows(millionths, keep_order=True)
    unique = millionths[distinct] / 1e6
    return trimesh.Trimesh(
        vertices=unique[:, :3],
        faces=inverse.reshape(-1, 3),
        vertex_normals=unique[:, 3:6],
        visual=TextureVisuals(uv=unique[:, 6:], material=material),
        metadata={"parts": names},
        process=False,
    )
