"""Primitives of a glTF file as meshes: triangles, strips and fans, morphed, skinned and decompressed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual import TextureVisuals

from data_gen.meshes.files import MeshError
from data_gen.meshes.formats.gltf.accessors import as_numbers, read_accessor, read_numbers
from data_gen.meshes.formats.gltf.container import Document, not_negative
from data_gen.meshes.formats.gltf.materials import GltfMaterial, TextureCoordinates
from data_gen.meshes.materials import EMISSIVE_UV, VERTEX_COLOUR, DrawnMaterial

__all__ = ["Skinning", "read_primitive"]

Floats = npt.NDArray[np.float64]
Skinning = Floats
"""Matrices `(joint, 4, 4)` from the mesh's rest coordinates to the scene's, in the pose of its joints."""

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MODES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


def read_primitive(
    document: Document,
    primitive: dict[str, Any],
    label: str,
    materials: Sequence[GltfMaterial],
    *,
    weights: Sequence[float],
    skinning: Skinning | None,
) -> trimesh.Trimesh | None:
    """Make a mesh of a primitive.

    Args:
        document: the file, with checked accessors.
        primitive: its JSON.
        label: its name in warnings.
        materials: the materials of the file.
        weights: of its morph targets; missing ones count as 0.
        skinning: the matrices of its joints, which replace its node's transform; None without a skin.

    Returns:
        The mesh, with `metadata["one_sided"]`; None, with a warning, for points and lines.

    Raises:
        MeshError: if its corners are not whole triangles, or compressed data cannot be read.
    """
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        document.warnings.append(f"{label}: {_MODES.get(mode, f'mode {mode}')} left out, only triangles are drawn")
        return None
    attributes = _Attributes(document, primitive, label)
    positions = attributes.raw("POSITION")
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise MeshError(f"{document.path}: {label}: expected positions (vertex, 3), found {positions.shape}")
    keywords: dict[str, Any] = {"vertices": attributes.floats("POSITION"), "process": False}
    keywords["faces"] = _faces(attributes.corners(len(positions)), mode, label, document)
    if "NORMAL" in attributes:
        keywords["vertex_normals"] = attributes.floats("NORMAL")
    _morph(attributes, primitive, weights, keywords)
    if skinning is not None:
        _skin(attributes, skinning, keywords)
    colours = attributes.raw("COLOR_0") if "COLOR_0" in attributes else None
    if colours is not None and (colours.ndim != 2 or len(colours) != len(positions)):
        document.warnings.append(f"{label}: {len(colours)} vertex colours for {len(positions)} vertices; left out")
        colours = None
    material = materials[not_negative(primitive["material"])] if "material" in primitive else None
    if material is None and colours is not None:
        material = GltfMaterial(DrawnMaterial())
    if material is not None:
        keywords["visual"] = _visual(attributes, material, colours)
    mesh = trimesh.Trimesh(**keywords)
    mesh.metadata["one_sided"] = material is None or not material.material.doubleSided
    if "NORMAL" not in attributes:
        mesh.metadata["smooth"] = False  # "client implementations MUST calculate flat normals" (glTF 2.0, 3.7.2.1)
    return mesh


class _Attributes:
    """The arrays of a primitive, from its accessors or its compressed block."""

    def __init__(self, document: Document, primitive: dict[str, Any], label: str) -> None:
        self.document, self.label = document, label
        self._accessors: dict[str, int] = primitive["attributes"]
        self._indices: int | None = primitive.get("indices")
        self._decoded: dict[str, npt.NDArray[Any]] = {}
        self._faces: npt.NDArray[Any] | None = None
        block = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
        if block is not None and any("bufferView" not in self._accessor(name) for name in self._accessors):
            self._decoded, self._faces = _decompress(document, block, label)

    def _accessor(self, name: str) -> dict[str, Any]:
        return self.document.items("accessors")[not_negative(self._accessors[name])]

    def __contains__(self, name: str) -> bool:
        return name in self._accessors

    def raw(self, name: str) -> npt.NDArray[Any]:
        """Items of an attribute as stored in the file."""
        if name not in self._decoded:
            return read_accessor(self.document, self._accessors[name])
        count = self._accessor(name)["count"]
        if len(self._decoded[name]) != count:
            raise MeshError(
                f"{self.document.path}: {self.label}: expected {count} vertices, found {len(self._decoded[name])} "
                "in its compressed data; export it again"
            )
        return self._decoded[name]

    def floats(self, name: str) -> npt.NDArray[Any]:
        """Items of an attribute as numbers, quantised ones decoded as glTF defines; float32 unchanged."""
        found = self.raw(name)
        if found.dtype.kind == "f":
            return found
        return as_numbers(found, normalised=bool(self._accessor(name).get("normalized")))

    def corners(self, vertices: int) -> npt.NDArray[np.int64]:
        """Vertex indices in the order of the primitive."""
        if self._faces is not None:
            return self._faces.reshape(-1).astype(np.int64)
        if self._indices is None:
            return np.arange(vertices, dtype=np.int64)
        return read_accessor(self.document, self._indices).reshape(-1).astype(np.int64)


def _decompress(
    document: Document, block: dict[str, Any], label: str
) -> tuple[dict[str, npt.NDArray[Any]], npt.NDArray[Any]]:
    """The arrays by attribute, and the triangles, of a Draco-compressed block."""
    try:
        import DracoPy
    except ImportError as error:
        raise MeshError(
            f"{document.path}: expected DracoPy for its KHR_draco_mesh_compression, found no such module; "
            "pip install 'hyperplanes[draco]', or export it without Draco compression"
        ) from error
    try:
        decoded = DracoPy.decode(bytes(document.view(block["bufferView"])))
    except (DracoPy.FileTypeException, RuntimeError, ValueError, AssertionError) as error:
        raise MeshError(
            f"{document.path}: {label}: expected data compressed by Draco, found {error}; export it again"
        ) from error
    arrays = {each["unique_id"]: each["data"] for each in decoded.attributes}
    faces = getattr(decoded, "faces", None)
    if faces is None or not set(block["attributes"].values()) <= set(arrays):
        raise MeshError(f"{document.path}: {label}: expected triangles in its compressed data, found none")
    return {name: arrays[number] for name, number in block["attributes"].items()}, np.asarray(faces)


def _faces(corners: npt.NDArray[np.int64], mode: int, label: str, document: Document) -> npt.NDArray[np.int64]:
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise MeshError(
                f"{document.path}: {label}: expected 3 corners a triangle, found {len(corners)}; export it again"
            )
        return corners.reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == _FAN:
        return np.stack((corners[1:-1], corners[2:], np.full(len(corners) - 2, corners[0])), axis=1)
    faces = np.stack((corners[:-2], corners[1:-1], corners[2:]), axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]  # every other triangle of a strip has the opposite winding
    return faces


def _morph(
    attributes: _Attributes, primitive: dict[str, Any], weights: Sequence[float], keywords: dict[str, Any]
) -> None:
    """Add the weighted morph targets."""
    names = {"POSITION": "vertices", "NORMAL": "vertex_normals"}
    for weight, target in zip(weights, primitive.get("targets", []), strict=False):
        for name, keyword in names.items():
            if weight and name in target and keyword in keywords:
                shift = read_numbers(attributes.document, target[name])
                if shift.shape != keywords[keyword].shape:
                    raise ValueError(f"a morph target of shape {shift.shape} for {keywords[keyword].shape}")
                keywords[keyword] = keywords[keyword] + float(weight) * shift


def _skin(attributes: _Attributes, skinning: Skinning, keywords: dict[str, Any]) -> None:
    """Move the vertices with their joints."""
    blended = np.zeros((len(keywords["vertices"]), 4, 4))
    number = 0
    while f"JOINTS_{number}" in attributes and f"WEIGHTS_{number}" in attributes:
        joints = attributes.raw(f"JOINTS_{number}").astype(np.int64)
        weights = attributes.floats(f"WEIGHTS_{number}")
        for column in range(4):
            blended += weights[:, column, None, None] * skinning[joints[:, column]]
        number += 1
    total = blended[:, 3, 3, None, None]
    blended = np.where(np.abs(total) > 1e-12, blended / np.where(total == 0.0, 1.0, total), np.eye(4))
    points = np.asarray(keywords["vertices"], dtype=np.float64)
    keywords["vertices"] = np.einsum("vij,vj->vi", blended[:, :3, :3], points) + blended[:, :3, 3]
    if "vertex_normals" in keywords:
        normals = np.asarray(keywords["vertex_normals"], dtype=np.float64)
        keywords["vertex_normals"] = np.einsum("vj,vji->vi", normals, np.linalg.pinv(blended[:, :3, :3]))


def _visual(attributes: _Attributes, material: GltfMaterial, colours: npt.NDArray[Any] | None) -> TextureVisuals:
    visual = TextureVisuals(uv=_uv(attributes, material.base), material=material.material)
    if colours is not None:
        visual.vertex_attributes[VERTEX_COLOUR] = colours.copy()
    if material.material.emissiveTexture is not None and material.emissive != material.base:
        uv = _uv(attributes, material.emissive)
        if uv is None:
            what = "its emissiveTexture has no coordinates; those of its base colour taken"
            attributes.document.warnings.append(f"{attributes.label}: {what}")
        else:
            visual.vertex_attributes[EMISSIVE_UV] = uv
    return visual


def _uv(attributes: _Attributes, coordinates: TextureCoordinates) -> Floats | None:
    """Coordinates with v upwards, as in trimesh."""
    name = f"TEXCOORD_{coordinates.set}"
    if name not in attributes:
        return None
    given = attributes.floats(name)
    uv = given.copy() if coordinates.transform is None else coordinates.apply(given.astype(np.float64))
    uv[:, 1] = 1.0 - uv[:, 1]
    return uv
