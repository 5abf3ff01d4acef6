"""Colours, textures and materials of a mesh, converted to the few forms that all renderers draw alike.

After `canonical_visual` a mesh has vertex colours, face colours, or a `PBRMaterial` whose base texture is RGB or
RGBA and has coordinates. Textures, vertex and face colours are sRGB; factors of materials and vertex colours that
multiply a material are LINEAR.
"""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
import PIL.Image
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import Material, MultiMaterial, PBRMaterial, SimpleMaterial

from data_gen.meshes.files import IMAGE_FORMATS
from hyperplanes.utilities.images.colour import linear_from_srgb, srgb_from_linear

__all__ = [
    "DEFAULT_COLOUR",
    "EMISSIVE_UV",
    "LINEAR_COLOUR",
    "VERTEX_COLOUR",
    "ColourSpace",
    "DrawnMaterial",
    "LinearMaterial",
    "Visual",
    "Wrap",
    "canonical_visual",
    "convert_image",
    "linear_colours",
    "linear_factor",
    "pbr_of_mtl",
    "roughness_of_exponent",
    "select_vertices",
    "texture_of",
    "visual_of",
]

ColourSpace = Literal["scene", "gltf", "srgb"]
"""Colour space of plain colours before: `scene` as after, `gltf` also linear on top of materials, `srgb` all sRGB."""

DEFAULT_COLOUR = (0.6, 0.6, 0.6, 1.0)
"""Linear RGBA of a surface without colour: a light grey."""

VERTEX_COLOUR, LINEAR_COLOUR, EMISSIVE_UV = "color", "linear_colour", "emissive_uv"
"""Vertex attributes of a TextureVisuals: colours on top of its material, as in the file and, in a canonical visual, as
linear RGBA in [0, 1]; coordinates of its emissive texture if they differ from those of the base colour."""

_MAP_SLOTS = ("metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")


Visual = ColorVisuals | TextureVisuals

Wrap = Literal["repeat", "clamp", "mirror"]
"""Wrap mode of a texture."""


class DrawnMaterial(PBRMaterial):
    """A PBRMaterial with glTF properties for which that class has no field.

    Attributes:
        unlit: whether its base colour is shown without lighting.
        wrap: wrap mode of its base colour texture along u and along v.
        emissive_wrap: that of its emissive texture.
    """

    unlit: bool = False
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    emissive_wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def with_fields_of(self, other: Material) -> Self:
        """Copy the attributes above from another material, and return itself."""
        if isinstance(other, DrawnMaterial):
            self.unlit, self.wrap, self.emissive_wrap = other.unlit, other.wrap, other.emissive_wrap
        return self


class LinearMaterial(DrawnMaterial):
    """A PBRMaterial that also keeps its linear base colour as floats.

    trimesh rounds it to 8 bits, whose steps are up to 13 of 255 in sRGB for dark colours.

    Args:
        baseColorFactor: linear RGBA in [0, 1].
        **values: other arguments of a PBRMaterial.
    """

    def __init__(self, *, baseColorFactor: npt.ArrayLike, **values: Any) -> None:
        self.exact = np.array(baseColorFactor, dtype=np.float64)
        super().__init__(baseColorFactor=self.exact.copy(), **values)

    def copy(self) -> LinearMaterial:
        """A copy with the same values; images are shared."""
        return LinearMaterial(**{**self._data, "baseColorFactor": linear_factor(self)}).with_fields_of(self)


def linear_factor(material: PBRMaterial) -> npt.NDArray[np.float64] | None:
    """Linear RGBA in [0, 1] of a material, as exactly as known; None if it states none."""
    factor = material.baseColorFactor
    if factor is None:
        return None
    rounded = np.asarray(factor, dtype=np.float64) / 255.0
    if isinstance(material, LinearMaterial) and np.abs(material.exact - rounded).max() < 0.51 / 255.0:
        return material.exact.copy()
    return rounded  # of another class, or changed since


def linear_colours(colours: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Linear RGBA in [0, 1] of sRGB colours (item, 4) from 0 to 255.

    >>> linear_colours([[0, 188, 255, 51]]).round(2).tolist()
    [[0.0, 0.5, 1.0, 0.2]]
    """
    rgba = np.asarray(colours, dtype=np.float64) / 255.0
    return np.concatenate((linear_from_srgb(rgba[:, :3]), rgba[:, 3:4]), axis=1)


def visual_of(mesh: trimesh.Trimesh) -> Visual:
    """The colours or the texture of a mesh; undefined colours if it has neither.

    >>> visual_of(trimesh.Trimesh()).defined
    False
    """
    visual = mesh.visual
    return ColorVisuals(mesh) if visual is None else visual


def texture_of(mesh: trimesh.Trimesh) -> TextureVisuals | None:
    """The texture of a mesh, if it has one."""
    visual = mesh.visual
    return visual if isinstance(visual, TextureVisuals) else None


def select_vertices(visual: TextureVisuals, used: npt.NDArray[np.int64]) -> TextureVisuals:
    """The same material with the coordinates and colours of some of its vertices."""
    selected = TextureVisuals(material=visual.material)
    for name, values in visual.vertex_attributes.items():
        selected.vertex_attributes[name] = values[used]
    return selected


def canonical_visual(
    mesh: trimesh.Trimesh, label: str, *, colours: ColourSpace, images: dict[Any, Any]
) -> tuple[Any, list[str], bool]:
    """Convert the colours of a mesh to a form that all renderers draw alike.

    Args:
        mesh: the mesh, which is not changed.
        label: its name in warnings.
        colours: colour space of its plain colours.
        images: converted textures, shared between the meshes of a scene.

    Returns:
        The visual, warnings about what was lost, and whether the surface is visible at all.
    """
    visual = visual_of(mesh)
    if isinstance(visual, TextureVisuals):
        return _textured(visual, mesh, label, colours, images)
    if not visual.defined:
        return TextureVisuals(material=PBRMaterial(baseColorFactor=DEFAULT_COLOUR, metallicFactor=0.0)), [], True
    kind = str(visual.kind)
    return _coloured(visual.vertex_colors if kind == "vertex" else visual.face_colors, kind, label)


def _coloured(values: Any, kind: str, label: str) -> tuple[Any, list[str], bool]:
    values = np.array(values, dtype=np.uint8)
    warnings = []
    if not values[:, 3].any():
        values[:, 3] = 255
        warnings.append(f"{label}: every colour has alpha 0; taken as opaque")
    keyword = "vertex_colors" if kind == "vertex" else "face_colors"
    return ColorVisuals(**{keyword: values}), warnings, True


def _textured(
    visual: TextureVisuals, mesh: trimesh.Trimesh, label: str, colours: ColourSpace, images: dict[Any, Any]
) -> tuple[Any, list[str], bool]:
    warnings: list[str] = []
    material = visual.material
    if isinstance(material, MultiMaterial):
        warnings.append(f"{label}: several materials on one surface; the first of {len(material.materials)} taken")
        material = material.materials[0] if material.materials else SimpleMaterial()
    is_gltf = isinstance(material, PBRMaterial)
    data = _pbr_values(material if is_gltf else pbr_of_mtl(material, images), images)
    if colours == "srgb" and is_gltf:
        data["baseColorFactor"][:3] = linear_from_srgb(data["baseColorFactor"][:3])
        if data["emissiveFactor"] is not None:
            data["emissiveFactor"] = linear_from_srgb(data["emissiveFactor"])
    coordinates = _coordinates(visual, len(mesh.vertices), label, warnings)
    if coordinates is None:
        _drop_textures(data, label, warnings)
    vertex_colours = _material_vertex_colours(visual, len(mesh.vertices))
    if data["alphaMode"] == "BLEND" and _hides_all(data, vertex_colours):
        data["alphaMode"] = "OPAQUE"
    own = material if isinstance(material, DrawnMaterial) else DrawnMaterial()
    multiplies = colours == "gltf" or data.get("baseColorTexture") is not None or own.unlit or _glows(data)
    if vertex_colours is not None and not multiplies:
        tint = np.append(srgb_from_linear(data["baseColorFactor"][:3]), data["baseColorFactor"][3])
        if data["alphaMode"] == "OPAQUE":
            vertex_colours[:, 3], tint[3] = 1.0, 1.0
        return _coloured((255.0 * vertex_colours * tint).round(), "vertex", label)
    data = {key: value for key, value in data.items() if value is not None}
    if data["alphaMode"] == "OPAQUE":
        data["baseColorFactor"][3] = 1.0
        if "baseColorTexture" in data:
            data["baseColorTexture"] = _converted(data["baseColorTexture"], "RGB", images)
    result = TextureVisuals(uv=coordinates, material=LinearMaterial(**data).with_fields_of(material))
    if vertex_colours is not None and (vertex_colours < 1.0).any():
        linear = vertex_colours
        if colours != "gltf":
            linear[:, :3] = linear_from_srgb(linear[:, :3])
        if data["alphaMode"] == "OPAQUE":
            linear[:, 3] = 1.0
        result.vertex_attributes[LINEAR_COLOUR] = linear
    uv = np.asarray(visual.vertex_attributes.get(EMISSIVE_UV, ()), dtype=np.float64)
    if "emissiveTexture" in data and uv.shape == (len(mesh.vertices), 2):
        result.vertex_attributes[EMISSIVE_UV] = np.where(np.isfinite(uv), uv, 0.0)
    return result, warnings, _visible(data)


def _hides_all(data: dict[str, Any], vertex_colours: npt.NDArray[np.float64] | None) -> bool:
    """Whether no point of a surface has alpha below 1."""
    image = data.get("baseColorTexture")
    clear = image is not None and image.mode == "RGBA" and image.getchannel("A").getextrema()[0] < 255
    painted = vertex_colours is not None and (vertex_colours[:, 3] < 1.0).any()
    return data["baseColorFactor"][3] >= 1.0 and not clear and not painted


def _glows(data: dict[str, Any]) -> bool:
    return data["emissiveFactor"] is not None and bool(data["emissiveFactor"].any())


def _drop_textures(data: dict[str, Any], label: str, warnings: list[str]) -> None:
    """Replace textures without coordinates by their mean colour."""
    image = data.get("baseColorTexture")
    if image is not None:
        mean = np.asarray(image.convert("RGB"), dtype=np.float64).reshape(-1, 3).mean(axis=0)
        data["baseColorFactor"][:3] *= linear_from_srgb(mean / 255.0)
        warnings.append(f"{label}: texture without texture coordinates; its mean colour taken")
    glow = data.get("emissiveTexture")
    if glow is not None and data["emissiveFactor"] is not None:
        mean = np.asarray(glow.convert("RGB"), dtype=np.float64).reshape(-1, 3).mean(axis=0)
        data["emissiveFactor"] = data["emissiveFactor"] * linear_from_srgb(mean / 255.0)
    for slot in ("baseColorTexture", *_MAP_SLOTS):
        data.pop(slot, None)


def _material_vertex_colours(visual: TextureVisuals, count: int) -> npt.NDArray[np.float64] | None:
    """RGBA in [0, 1] of vertex colours on top of a material, as in the file."""
    attribute = visual.vertex_attributes.get(VERTEX_COLOUR) if hasattr(visual, "vertex_attributes") else None
    if attribute is None or len(attribute) != count:
        return None
    colours = np.asarray(attribute)
    top = 1.0 if colours.dtype.kind == "f" else float(np.iinfo(colours.dtype).max)
    rgba = np.ones((count, 4))
    rgba[:, : colours.shape[1]] = np.clip(np.nan_to_num(colours / top), 0.0, 1.0)
    return rgba


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


def _pbr_values(material: PBRMaterial, images: dict[Any, Any]) -> dict[str, Any]:
    factor = linear_factor(material)
    emissive = material.emissiveFactor
    cutoff = 0.5 if material.alphaCutoff is None else float(material.alphaCutoff)
    return {
        "name": material.name,
        "alphaMode": material.alphaMode if material.alphaMode in ("MASK", "BLEND") else "OPAQUE",
        "alphaCutoff": min(max(cutoff, 0.0), 1.0),
        "baseColorFactor": np.ones(4) if factor is None else factor,
        "baseColorTexture": _converted(material.baseColorTexture, "RGBA", images),
        "metallicFactor": material.metallicFactor,
        "roughnessFactor": material.roughnessFactor,
        **{slot: _converted(getattr(material, slot), "RGB", images) for slot in _MAP_SLOTS},
        "emissiveFactor": None if emissive is None else np.asarray(emissive, dtype=np.float64)[:3],
        "doubleSided": bool(material.doubleSided),
    }


def pbr_of_mtl(material: SimpleMaterial, images: dict[Any, Any] | None = None) -> LinearMaterial:
    """The glTF equivalent of a material of an MTL file, or of a texture without one.

    Args:
        material: its `diffuse` is sRGB; a texture replaces it, since programs write any colour beside one.
        images: converted textures, shared between the meshes of a scene.

    Returns:
        The material, its factor linear; the specular exponent (Ns) gives the roughness.
    """
    image = _converted(material.image, "RGBA", {} if images is None else images)
    colour = np.asarray(material.diffuse, dtype=np.float64) / 255.0
    factor = np.append(linear_from_srgb(colour[:3]) if image is None else np.ones(3), colour[3])
    return LinearMaterial(
        name=material.name,
        alphaMode="BLEND",
        baseColorFactor=factor,
        baseColorTexture=image,
        metallicFactor=0.0,
        roughnessFactor=roughness_of_exponent(float(material.glossiness or 1.0)),
    )


def roughness_of_exponent(exponent: float) -> float:
    """Roughness of a highlight that falls off with the cosine to the power of `exponent` (Ns of an MTL file)."""
    return float((2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25)


def _converted(image: PIL.Image.Image | None, mode: str, images: dict[Any, Any]) -> PIL.Image.Image | None:
    """An image with 8 bits per channel: RGB, or RGBA if alpha is wanted and present."""
    if image is None:
        return None
    key = (id(image), mode)
    if key not in images:
        images[key] = (convert_image(image, mode), image)  # keep the source, so that its id is not reused
    return images[key][0]


def convert_image(image: PIL.Image.Image, mode: str) -> PIL.Image.Image | None:
    """An image with 8 bits per channel.

    Args:
        image: as opened by Pillow.
        mode: RGB, or RGBA for RGB with alpha if the image has any.

    Returns:
        The image; None if it cannot be decoded, about which the reader of the file has warned.
    """
    if image.format not in (None, "MPO", *IMAGE_FORMATS):  # MPO: a JPEG with further pictures
        return None
    try:
        image.load()
    except (OSError, SyntaxError, ValueError):
        return None
    if image.mode.startswith(("I", "F")):
        top = 65535.0 if image.mode.startswith("I") else 1.0
        image = PIL.Image.fromarray(np.clip(np.asarray(image) / top * 255.0, 0, 255).astype(np.uint8))
    return image.convert("RGBA" if mode == "RGBA" and image.has_transparency_data else "RGB")


def _visible(data: dict[str, Any]) -> bool:
    """Whether any point of a surface can have alpha above 0."""
    alpha = float(data["baseColorFactor"][3])
    image = data.get("baseColorTexture")
    if image is not None and image.mode == "RGBA":
        alpha *= image.getchannel("A").getextrema()[1] / 255.0
    return alpha >= data["alphaCutoff"] if data["alphaMode"] == "MASK" else alpha > 0
