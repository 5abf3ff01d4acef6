"""Materials and textures of a glTF file, as trimesh's PBRMaterial with additional properties.

trimesh converts the specular-glossiness workflow, from images with 8 bits per channel: alone it would take palette
indices for grey values. Transmission is drawn as opacity, without refraction.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import PIL.Image
from trimesh.visual.gloss import specular_to_pbr

from data_gen.meshes.files import IMAGE_FORMATS
from data_gen.meshes.formats.gltf.container import Document, not_negative, read_uri
from data_gen.meshes.materials import DEFAULT_COLOUR, DrawnMaterial, LinearMaterial, Wrap, convert_image
from hyperplanes.utilities.images.colour import linear_from_srgb

__all__ = ["WRAPS", "GltfMaterial", "TextureCoordinates", "read_materials"]

_SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
_FACTORS = (
    *("baseColorFactor", "metallicFactor", "roughnessFactor", "emissiveFactor"),
    *("alphaMode", "alphaCutoff", "doubleSided"),
)
_SLOTS = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
_GLOSSINESS_FACTORS = ("specularFactor", "glossinessFactor", "diffuseFactor")
_GLOSSINESS_SLOTS = ("diffuseTexture", "specularGlossinessTexture")
WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
"""Wrap modes by glTF sampler constant."""

_CLEAREST = 0.1


@dataclass(frozen=True)
class TextureCoordinates:
    """The source of a texture's coordinates.

    Attributes:
        set: number n of the attribute TEXCOORD_n.
        transform: KHR_texture_transform as a matrix `(2, 3)` on (u, v, 1), v downwards, or None.
    """

    set: int = 0
    transform: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    def apply(self, uv: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The transformed coordinates `(vertex, 2)`, v downwards as before."""
        if self.transform is None:
            return uv
        matrix = np.array(self.transform)
        return uv @ matrix[:, :2].T + matrix[:, 2]


@dataclass(frozen=True)
class GltfMaterial:
    """A material of the file.

    Attributes:
        material: the material to draw.
        base: coordinates of its base colour texture, or of its emissive texture if that is the only one.
        emissive: coordinates of its emissive texture.
    """

    material: DrawnMaterial
    base: TextureCoordinates = TextureCoordinates()
    emissive: TextureCoordinates = TextureCoordinates()


def read_materials(document: Document) -> list[GltfMaterial]:
    """All materials of a file; the document's warnings name what is lost.

    Returns:
        The materials, plain factors linear. White ones whose base colour texture is lost are grey.
    """
    textures = _Textures(document)
    return [_material(values, index, textures, document) for index, values in enumerate(document.items("materials"))]


class _Textures:
    """Decoded textures of a file, each image once."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._lost: dict[int, str] = {}
        self._images = [self._image(index, image) for index, image in enumerate(document.items("images"))]

    def _image(self, index: int, image: dict[str, Any]) -> PIL.Image.Image | None:
        document, folder = self._document, self._document.folder
        name = image.get("uri") or image.get("name") or f"image {index}"
        name = name if len(name) < 100 else f"image {index}"
        if image.get("mimeType") == "image/ktx2":
            self._lost[index] = f"{name} (KTX2 is not supported)"
            folder.lost.setdefault(name, "KTX2 is not supported")
            return None
        data: bytes | memoryview | None
        if "bufferView" in image:
            data = document.view(image["bufferView"])
        else:
            data = read_uri(image["uri"], folder, f"{folder.path}: {name}", image=True) if image.get("uri") else None
        if data is None:
            self._lost[index] = f"{name} ({folder.lost.get(image.get('uri', ''), 'not found')})"
            return None
        if "uri" not in image or image["uri"].startswith("data:"):
            try:
                folder.count_pixels(bytes(data), name)
            except FileNotFoundError:
                self._lost[index] = f"{name} ({folder.lost.get(name, 'not decoded')})"
                return None
        return PIL.Image.open(io.BytesIO(data), formats=IMAGE_FORMATS)

    def find(self, values: dict[str, Any], slot: str, label: str) -> PIL.Image.Image | None:
        """The image in a slot of a material; None without one, with a warning if it is lost."""
        texture = self._texture(values, slot)
        if texture is None:
            if slot in values:
                self._warn(f"{label}: {slot} refers to a texture that is not there; drawn without")
            return None
        source = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source", texture.get("source"))
        if source is None or source in self._lost:
            reason = "which has no image" if source is None else self._lost[source]
            self._warn(f"{label}: drawn without its {slot} {reason}")
            return None
        return self._images[not_negative(source)]

    def wrap(self, values: dict[str, Any], slot: str) -> tuple[Wrap, Wrap]:
        """Wrap mode of the texture in a slot along u and along v."""
        texture = self._texture(values, slot)
        if texture is None or "sampler" not in texture:
            return "repeat", "repeat"
        sampler = self._document.items("samplers")[not_negative(texture["sampler"])]
        return WRAPS.get(sampler.get("wrapS", 10497), "repeat"), WRAPS.get(sampler.get("wrapT", 10497), "repeat")

    def _texture(self, values: dict[str, Any], slot: str) -> dict[str, Any] | None:
        textures = self._document.items("textures")
        if slot not in values or not 0 <= values[slot]["index"] < len(textures):
            return None
        return textures[values[slot]["index"]]

    def _warn(self, line: str) -> None:
        if line not in self._document.warnings:
            self._document.warnings.append(line)


def _material(values: dict[str, Any], index: int, textures: _Textures, document: Document) -> GltfMaterial:
    label = f"material {values.get('name', index)!r}"
    extensions = values.get("extensions", {})
    values = {**values, **values.get("pbrMetallicRoughness", {})}
    keywords: dict[str, Any] = {key: values[key] for key in _FACTORS if values.get(key) is not None}
    base_slot = "baseColorTexture"
    glossy = extensions.get(_SPECULAR_GLOSSINESS)
    for slot in _SLOTS:
        # The other description of the same surface is not drawn, so losses in it do not matter.
        if glossy is None or slot not in ("baseColorTexture", "metallicRoughnessTexture"):
            keywords[slot] = textures.find(values, slot, label)
    if glossy is not None:
        values, base_slot = {**values, **glossy}, "diffuseTexture"
        keywords |= _from_glossiness(glossy, textures, label)
    keywords = {key: value for key, value in keywords.items() if value is not None}
    if "baseColorFactor" in keywords:
        keywords["baseColorFactor"] = np.clip(np.asarray(keywords["baseColorFactor"], dtype=np.float64), 0, 1)
    if "emissiveFactor" in keywords:
        strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
        keywords["emissiveFactor"] = np.asarray(keywords["emissiveFactor"], dtype=np.float64) * max(strength, 0.0)
    kind = LinearMaterial if "baseColorFactor" in keywords else DrawnMaterial
    material = kind(name=values.get("name"), **keywords)
    material.unlit = "KHR_materials_unlit" in extensions
    material.wrap = textures.wrap(values, base_slot)
    material.emissive_wrap = textures.wrap(values, "emissiveTexture")
    if base_slot in values and "baseColorTexture" not in keywords:
        _set_default_colour(material)
    if (transmission := extensions.get("KHR_materials_transmission")) is not None:
        _set_opacity(material, float(transmission.get("transmissionFactor", 0.0)), label, document)
    emissive = _coordinates(values.get("emissiveTexture", {}))
    has_base = material.baseColorTexture is not None
    return GltfMaterial(material, _coordinates(values.get(base_slot, {})) if has_base else emissive, emissive)


def _from_glossiness(glossy: dict[str, Any], textures: _Textures, label: str) -> dict[str, Any]:
    """Keywords of a PBRMaterial for a material in the specular-glossiness workflow."""
    keywords: dict[str, Any] = {key: np.array(glossy[key]) for key in _GLOSSINESS_FACTORS if key in glossy}
    if "glossinessFactor" in keywords:
        keywords["glossinessFactor"] = float(keywords["glossinessFactor"])
    for slot in _GLOSSINESS_SLOTS:
        image = textures.find(glossy, slot, label)
        if image is not None:
            keywords[slot] = convert_image(image, "RGBA")
    return specular_to_pbr(**keywords)


def _coordinates(reference: dict[str, Any]) -> TextureCoordinates:
    moved = reference.get("extensions", {}).get("KHR_texture_transform", {})
    number = moved.get("texCoord", reference.get("texCoord", 0))
    (u, v), (across, down) = moved.get("offset", (0.0, 0.0)), moved.get("scale", (1.0, 1.0))
    angle = moved.get("rotation", 0.0)
    if (u, v, across, down, angle) == (0, 0, 1, 1, 0):
        return TextureCoordinates(number)
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return TextureCoordinates(number, ((c * across, s * down, u), (-s * across, c * down, v)))


def _set_default_colour(material: DrawnMaterial) -> None:
    """Make a white material grey if its texture is lost: white would be invisible over white."""
    factor = material.baseColorFactor
    if factor is None or (np.asarray(factor)[:3] == 255).all():
        material.baseColorFactor = DEFAULT_COLOUR


def _set_opacity(material: DrawnMaterial, transmission: float, label: str, document: Document) -> None:
    """Replace transmission by opacity: clear surfaces transmit light, coloured ones absorb part of it."""
    factor = np.ones(4) if material.baseColorFactor is None else np.asarray(material.baseColorFactor) / 255.0
    colour = factor[:3]
    if material.baseColorTexture is not None:
        texels = np.asarray(material.baseColorTexture.convert("RGB"), dtype=np.float64).reshape(-1, 3)
        colour = colour * linear_from_srgb(texels.mean(axis=0) / 255.0)
    metallic = 1.0 if material.metallicFactor is None else float(material.metallicFactor)
    through = float(np.clip(transmission, 0.0, 1.0)) * float(colour.mean()) * (1.0 - metallic)
    if through > 0.0:
        opacity = max(1.0 - through, _CLEAREST)
        material.baseColorFactor = (*factor[:3], factor[3] * opacity)
        material.alphaMode = "BLEND"
        document.warnings.append(f"{label}: KHR_materials_transmission drawn as opacity {opacity:.2f}")
