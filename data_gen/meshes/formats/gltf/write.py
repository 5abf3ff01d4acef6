"""Writes GLB files that match what is drawn, with trimesh and corrections of its output.

trimesh writes vertex colours as sRGB bytes, which are linear in glTF, face colours as means around each vertex, base
colours in 8 bits, and no second coordinates, wrap modes or unlit materials; sidedness and metalness get glTF's defaults
if a material does not state them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from data_gen.meshes.formats.gltf.materials import WRAPS
from data_gen.meshes.materials import (
    EMISSIVE_UV,
    LINEAR_COLOUR,
    DrawnMaterial,
    Wrap,
    linear_colours,
    linear_factor,
    texture_of,
    visual_of,
)

__all__ = ["write_glb"]

_GENERATOR = "HyperPlanes"  # the reader assumes sRGB colours in files by trimesh


def write_glb(scene: trimesh.Scene) -> bytes:
    """A `Mesh.scene` as a GLB file, in its coordinates.

    Args:
        scene: geometries with canonical visuals and without transforms.
    """
    written = trimesh.Scene()
    for name, mesh in scene.geometry.items():
        written.add_geometry(_with_attributes(mesh), geom_name=name, node_name=name)

    def complete(tree: dict[str, Any]) -> None:
        tree["asset"]["generator"] = _GENERATOR
        materials: list[dict[str, Any]] = []
        for name, entry in zip(written.geometry, tree["meshes"], strict=True):
            (primitive,) = entry["primitives"]
            attributes = primitive["attributes"]
            primitive["attributes"] = {key.removeprefix("_"): value for key, value in attributes.items()}
            stated = tree["materials"][primitive["material"]]
            visual, metadata = written.geometry[name].visual, scene.geometry[name].metadata
            material = _material(stated, visual.material, "_TEXCOORD_1" in attributes, tree)
            material["doubleSided"] = not (metadata.get("closed") or metadata.get("one_sided"))
            primitive["material"] = _index(materials, material)
        tree["materials"] = materials
        used = {name for material in materials for name in material.get("extensions", ())}
        if used:
            tree["extensionsUsed"] = sorted(used)

    return export_glb(written, tree_postprocessor=complete)


def _with_attributes(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A mesh with a material; trimesh writes its other attributes with an underscore before their names."""
    visual, texture = visual_of(mesh), texture_of(mesh)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    normals = np.asarray(mesh.vertex_normals) if mesh.metadata.get("smooth") else None
    attributes: dict[str, npt.ArrayLike] = {}
    if isinstance(visual, ColorVisuals):
        if visual.kind == "face":
            vertices, faces = vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
            colours = linear_colours(visual.face_colors).repeat(3, axis=0)
        else:
            colours = linear_colours(visual.vertex_colors)
        mode = "OPAQUE" if (colours[:, 3] >= 1.0).all() else "BLEND"
        texture = TextureVisuals(material=PBRMaterial(alphaMode=mode))
        attributes["_COLOR_0"] = colours
    else:
        assert texture is not None
        if LINEAR_COLOUR in texture.vertex_attributes:
            attributes["_COLOR_0"] = texture.vertex_attributes[LINEAR_COLOUR]
        if EMISSIVE_UV in texture.vertex_attributes:
            attributes["_TEXCOORD_1"] = np.array([0.0, 1.0]) + texture.vertex_attributes[EMISSIVE_UV] * [1.0, -1.0]
    return trimesh.Trimesh(
        vertices, faces, vertex_normals=normals, visual=texture, vertex_attributes=attributes, process=False
    )


def _material(stated: dict[str, Any], material: PBRMaterial, second: bool, tree: dict[str, Any]) -> dict[str, Any]:
    """A material as written by trimesh, completed."""
    drawn = material if isinstance(material, DrawnMaterial) else DrawnMaterial()
    factors = {**stated.get("pbrMetallicRoughness", {}), "metallicFactor": float(material.metallicFactor or 0.0)}
    result = {**stated, "pbrMetallicRoughness": factors}
    if stated.get("alphaMode") != "MASK":
        result.pop("alphaCutoff", None)
    factor = linear_factor(material)
    if factor is not None:
        factors["baseColorFactor"] = factor.tolist()
    if "baseColorTexture" in factors:
        factors["baseColorTexture"] = _wrapped(factors["baseColorTexture"], drawn.wrap, tree)
    if "emissiveTexture" in stated:
        result["emissiveTexture"] = _wrapped(stated["emissiveTexture"], drawn.emissive_wrap, tree)
        result["emissiveTexture"] |= {"texCoord": 1} if second else {}
    extensions: dict[str, Any] = {"KHR_materials_unlit": {}} if drawn.unlit else {}
    strength = max(stated.get("emissiveFactor", [0.0]))
    if strength > 1.0:
        result["emissiveFactor"] = [value / strength for value in stated["emissiveFactor"]]
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
    return result | ({"extensions": extensions} if extensions else {})


def _wrapped(reference: dict[str, Any], wrap: tuple[Wrap, Wrap], tree: dict[str, Any]) -> dict[str, Any]:
    """A reference to a texture with a wrap mode; glTF's default is to repeat."""
    if wrap == ("repeat", "repeat"):
        return reference
    codes = {kind: code for code, kind in WRAPS.items()}
    sampler = _index(tree.setdefault("samplers", []), {"wrapS": codes[wrap[0]], "wrapT": codes[wrap[1]]})
    return {"index": _index(tree["textures"], tree["textures"][reference["index"]] | {"sampler": sampler})}


def _index(items: list[dict[str, Any]], item: dict[str, Any]) -> int:
    """The index of an item in a list, appended if absent."""
    if item not in items:
        items.append(item)
    return items.index(item)
