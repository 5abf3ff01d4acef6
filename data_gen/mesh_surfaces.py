"""Colours, textures and materials of a mesh, brought into the few forms that every renderer draws alike.

After ``canonical_visual`` a mesh has vertex colours, face colours, or a ``PBRMaterial`` whose base texture is RGB or
RGBA and has coordinates. Factors and vertex colours are LINEAR, textures sRGB, as in glTF.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import PIL.Image
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import MultiMaterial, PBRMaterial, SimpleMaterial

__all__ = ["DEFAULT_COLOUR", "canonical_visual", "linear_from_srgb"]

DEFAULT_COLOUR = (0.55, 0.55, 0.55, 1.0)
"""Linear RGBA of a surface that says nothing about its colour: a light grey."""


def linear_from_srgb(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Turn sRGB colours into linear ones; a fourth channel (alpha) stays.

    Args:
        colours: ``(..., 3)`` or ``(..., 4)``, 0 to 255.

    Returns:
        The same shape.

    >>> linear_from_srgb(np.array([0, 188, 255, 128], np.uint8)).tolist()
    [0, 128, 255, 128]
    """
    result = np.array(colours, dtype=np.uint8, copy=True)
    value = result[..., :3] / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    result[..., :3] = np.round(linear * 255.0)
    return result


def canonical_visual(mesh: trimesh.Trimesh, label: str, *, srgb: bool) -> tuple[Any, list[str], bool]:
    """Bring what colours a mesh into a form that every renderer draws alike.

    Args:
        mesh: The mesh, which is not changed.
        label: What to call it in a warning.
        srgb: Whether its plain colours (materials and vertices, not textures) are sRGB, as everywhere but in glTF.

    Returns:
        The visual, warnings that name what was lost, and whether the surface can be seen at all.
    """
    visual = mesh.visual
    if isinstance(visual, TextureVisuals):
        return _textured(visual, mesh, label, srgb)
    if not visual.defined:
        return TextureVisuals(material=PBRMaterial(baseColorFactor=DEFAULT_COLOUR, metallicFactor=0.0)), [], True
    kind = visual.kind
    colours = np.array(visual.vertex_colors if kind == "vertex" else visual.face_colors, dtype=np.uint8)
    warnings = []
    if not colours[:, 3].any():
        colours[:, 3] = 255
        warnings.append(f"{label}: every colour has alpha 0; taken as opaque")
    if srgb:
        colours = linear_from_srgb(colours)
    keyword = "vertex_colors" if kind == "vertex" else "face_colors"
    return ColorVisuals(**{keyword: colours}), warnings, True


def _textured(visual: TextureVisuals, mesh: trimesh.Trimesh, label: str, srgb: bool) -> tuple[Any, list[str], bool]:
    warnings: list[str] = []
    material = visual.material
    if isinstance(material, MultiMaterial):
        warnings.append(f"{label}: several materials on one surface; the first of {len(material.materials)} taken")
        material = material.materials[0] if material.materials else SimpleMaterial()
    data = _pbr_values(material) if isinstance(material, PBRMaterial) else _mtl_values(material, srgb)
    mode = data.pop("alphaMode")
    coordinates = _coordinates(visual, len(mesh.vertices), label, warnings)
    if coordinates is None:
        if (image := data.get("baseColorTexture")) is not None:
            mean = np.asarray(image.convert("RGB"), dtype=np.float64).reshape(-1, 3).mean(axis=0)
            tint = linear_from_srgb(mean.astype(np.uint8)) / 255.0
            data["baseColorFactor"][:3] *= tint
            warnings.append(f"{label}: texture without texture coordinates; its mean colour taken")
        for key in [key for key in data if key.endswith("Texture")]:
            del data[key]
    data = {key: value for key, value in data.items() if value is not None}
    _apply_alpha(data, mode)
    visible = data["baseColorFactor"][3] > 0 and not _all_clear(data.get("baseColorTexture"))
    return TextureVisuals(uv=coordinates, material=PBRMaterial(**data)), warnings, bool(visible)


def _coordinates(visual: TextureVisuals, count: int, label: str, warnings: list[str]) -> npt.NDArray[np.float64] | None:
    if visual.uv is None or not len(visual.uv):
        return None
    uv = np.array(visual.uv, dtype=np.float64)
    if uv.ndim != 2 or uv.shape[0] != count or uv.shape[1] < 2:
        warnings.append(f"{label}: texture coordinates of shape {uv.shape} for {count} vertices; left out")
        return None
    uv = uv[:, :2]
    wrong = ~np.isfinite(uv).all(axis=1)
    if wrong.any():
        uv[wrong] = 0.0
        warnings.append(f"{label}: {int(wrong.sum())} texture coordinates are not finite; set to 0")
    return uv


def _pbr_values(material: PBRMaterial) -> dict[str, Any]:
    factor = material.baseColorFactor
    factor = np.ones(4) if factor is None else np.asarray(factor, dtype=np.float64) / 255.0
    emissive = material.emissiveFactor
    return {
        "name": material.name,
        "alphaMode": material.alphaMode or "OPAQUE",
        "alphaCutoff": float(np.clip(0.5 if material.alphaCutoff is None else material.alphaCutoff, 0.0, 1.0)),
        "baseColorFactor": factor.copy(),
        "baseColorTexture": _plain(material.baseColorTexture, "RGBA"),
        "metallicFactor": 1.0 if material.metallicFactor is None else float(material.metallicFactor),
        "roughnessFactor": 1.0 if material.roughnessFactor is None else float(material.roughnessFactor),
        "metallicRoughnessTexture": _plain(material.metallicRoughnessTexture, "RGB"),
        "normalTexture": _plain(material.normalTexture, "RGB"),
        "occlusionTexture": _plain(material.occlusionTexture, "RGB"),
        "emissiveTexture": _plain(material.emissiveTexture, "RGB"),
        "emissiveFactor": None if emissive is None else np.asarray(emissive, dtype=np.float64)[:3],
        "doubleSided": bool(material.doubleSided),
    }


def _mtl_values(material: SimpleMaterial, srgb: bool) -> dict[str, Any]:
    image = _plain(material.image, "RGBA")
    diffuse = np.asarray(material.diffuse, dtype=np.uint8)
    factor = (linear_from_srgb(diffuse) if srgb else diffuse) / 255.0
    if image is not None:
        factor[:3] = 1.0
    opacity = material.kwargs.get("d")
    if opacity:
        try:
            factor[3] = float(np.clip(float(opacity[-1]), 0.0, 1.0))
        except ValueError:
            factor[3] = 1.0
    shininess = max(float(material.glossiness or 1.0), 0.0)
    return {
        "name": material.name,
        "alphaMode": "BLEND",
        "baseColorFactor": factor,
        "baseColorTexture": image,
        "metallicFactor": 0.0,
        "roughnessFactor": float((2.0 / (shininess + 2.0)) ** 0.25),
    }


def _plain(image: PIL.Image.Image | None, mode: str) -> PIL.Image.Image | None:
    """An image of 8 bits a channel: RGB, or RGBA where alpha is wanted and there is some."""
    if image is None:
        return None
    if image.mode.startswith(("I", "F")):
        values = np.asarray(image, dtype=np.float64)
        top = 65535.0 if image.mode.startswith("I") else 1.0
        image = PIL.Image.fromarray(np.clip(values / top * 255.0, 0, 255).astype(np.uint8))
    with_alpha = mode == "RGBA" and image.has_transparency_data
    return image.convert("RGBA" if with_alpha else "RGB")


def _apply_alpha(data: dict[str, Any], mode: str) -> None:
    """Make blending, the only mode the renderers know, mean what the material's alpha mode says."""
    image = data.get("baseColorTexture")
    if mode == "OPAQUE":
        data["baseColorFactor"][3] = 1.0
        if image is not None:
            data["baseColorTexture"] = image.convert("RGB")
    elif mode == "MASK" and image is not None and image.mode == "RGBA":
        threshold = data.get("alphaCutoff", 0.5) * 255.0 / max(float(data["baseColorFactor"][3]), 1e-6)
        image.putalpha(image.getchannel("A").point([255 if value >= threshold else 0 for value in range(256)]))
        data["baseColorFactor"][3] = 1.0
    elif mode == "MASK":
        data["baseColorFactor"][3] = float(data["baseColorFactor"][3] >= data.get("alphaCutoff", 0.5))
    data["alphaMode"] = "BLEND" if mode != "OPAQUE" else "OPAQUE"


def _all_clear(image: PIL.Image.Image | None) -> bool:
    return image is not None and image.mode == "RGBA" and image.getchannel("A").getextrema()[1] == 0
