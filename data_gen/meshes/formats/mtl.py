"""Reads the MTL files (materials and their textures) of an OBJ file.

trimesh's reader drops opacity (`d`, `Tr`), emission, and textures behind options (`map_Kd -s 1 1 1 wood.png`). Of the
options, those that move a texture (`-s`, `-o`) and `-clamp` are drawn.

A texture replaces `Kd`, as in Blender and thus in the pictures of ShapeNet: exporters write any Kd beside it. Opacity
is that of `d` times that of `map_d` (its alpha if it has one, else its brightness), never the alpha of `map_Kd`; `Tr`
is 1 - d where there is no d, but many programs write a lone `Tr 1` for opaque.

`Kd` and `Ke` are sRGB, like the colours on their authors' screens: 3ds Max writes its grey of 150/255 as 0.588. A ball
of it in studio light has at most 165 of 255; read as linear, as by Blender's importer, it has 209, and a dark 0.2 (51
of 255) becomes up to 143 instead of 97.
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
import PIL.Image

from data_gen.meshes.files import IMAGE_FORMATS, MAX_TEXT_BYTES, MeshError, decode_text
from data_gen.meshes.materials import LinearMaterial, convert_image, roughness_of_exponent
from data_gen.meshes.model_folder import ModelFolder, without_comment
from hyperplanes.utilities.images.colour import linear_from_srgb

__all__ = ["MAX_LIBRARIES", "MtlMaterial", "find_material", "read_materials"]

MAX_LIBRARIES = 1000
"""Most different material libraries of an OBJ file."""

_MOVE = re.compile(r"(?:^|\s)-(s|o)((?:\s+[-+]?[\d.]+(?:[eE][-+]?\d+)?(?=\s)){1,3})")
_CLAMP = re.compile(r"(?:^|\s)-clamp\s+on\s")


class MtlMaterial(LinearMaterial):
    """A LinearMaterial with a scale and an offset of its texture.

    Attributes:
        scale: factors `(2,)` of u and v.
        offset: added afterwards `(2,)`.
    """

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def read_materials(libraries: list[str], folder: ModelFolder, warnings: list[str]) -> dict[str, MtlMaterial]:
    """Read all material libraries of an OBJ file; the folder refuses what lies outside it.

    Args:
        libraries: the text after each `mtllib`: one name, possibly with spaces, or several.
        folder: gives the files.
        warnings: receives a line for everything that was lost.

    Returns:
        Materials by name, colours linear.

    Raises:
        MeshError: if there are too many libraries.
    """
    materials: dict[str, MtlMaterial] = {}
    different = list(dict.fromkeys(libraries))
    if len(different) > MAX_LIBRARIES:
        raise MeshError(
            f"{folder.path}: expected at most {MAX_LIBRARIES} material libraries, found {len(different)}; merge them"
        )
    for line in different:
        words = without_comment(line).split()
        whole = len(words) < 2 or not words[-1].lower().endswith(".mtl") or folder.locate(line) is not None
        names = [line] if whole else words
        for name in names:
            try:
                text = decode_text(folder.read(name, limit=MAX_TEXT_BYTES))
            except FileNotFoundError:
                continue
            for values in _statements(text, name, warnings):
                materials.setdefault(values["name"], _material(values, folder, warnings))
    return materials


def find_material(name: str, materials: dict[str, MtlMaterial]) -> MtlMaterial | None:
    """The material that an OBJ file names.

    Args:
        name: the text after `usemtl`.
        materials: by name. All these names may contain comments, which are ignored if the whole name is not found.

    Returns:
        The material; None if there is none, or several that differ only in possible comments.
    """
    if name in materials:
        return materials[name]
    plain = without_comment(name)
    alike = [material for other, material in materials.items() if without_comment(other) == plain]
    return materials.get(plain, alike[0] if len(alike) == 1 else None)


def _statements(text: str, library: str, warnings: list[str]) -> list[dict[str, Any]]:
    """The statements of each material, keywords in lower case."""
    found: list[dict[str, Any]] = []
    orphans = 0
    for line in text.splitlines():
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        keyword, rest = keyword.lower(), rest.strip()
        if not keyword or keyword.startswith("#"):
            continue
        if keyword == "newmtl":
            found.append({"name": rest})
        elif found:
            found[-1][keyword] = rest
        else:
            orphans += 1
    if orphans or not found:
        warnings.append(f"{library}: expected materials, found {orphans} statements before the first newmtl")
    return found


def _material(values: dict[str, Any], folder: ModelFolder, warnings: list[str]) -> MtlMaterial:
    label = f"material {values['name']!r}"
    colour = np.array([*_floats(values.get("kd"), 3, (0.8, 0.8, 0.8), f"{label}: Kd", warnings), 1.0])
    colour[:3] = linear_from_srgb(np.clip(colour[:3], 0.0, 1.0))
    colour[3] = _opacity(values, label, warnings)
    image = _texture(values, label, folder, warnings)
    if image is not None and (values.get("map_kd") or values.get("map_ka")):
        colour[:3] = 1.0
    exponent = _floats(values.get("ns"), 1, (10.0,), f"{label}: Ns", warnings)[0]
    glow = _floats(values.get("ke"), 3, (0.0, 0.0, 0.0), f"{label}: Ke", warnings)
    glow = linear_from_srgb(np.clip(glow, 0.0, 1.0))
    glow_map = _image(values.get("map_ke"), f"{label}: drawn without its glow and its map", folder, warnings)
    if values.get("map_ke"):
        glow = np.zeros(3) if glow_map is None else glow if glow.any() else np.ones(3)
    material = MtlMaterial(
        name=values["name"],
        baseColorFactor=colour,
        baseColorTexture=image,
        alphaMode="BLEND",
        metallicFactor=0.0,
        roughnessFactor=roughness_of_exponent(exponent),
        emissiveFactor=glow if glow.any() else None,
        emissiveTexture=glow_map if glow.any() else None,
    )
    options = values.get("map_kd") or values.get("map_ka") or values.get("map_d") or values.get("map_ke") or ""
    for option, numbers in _MOVE.findall(options):
        u, v, *_ = *(float(number) for number in numbers.split()), *([1.0, 1.0] if option == "s" else [0.0, 0.0])
        if not np.isfinite((u, v)).all():
            warnings.append(f"{label}: -{option} of its texture is not finite; left out")
        elif option == "s":
            material.scale = u, v
        else:
            material.offset = u, v
    if _CLAMP.search(options):
        material.wrap = material.emissive_wrap = ("clamp", "clamp")
    return material


def _opacity(values: dict[str, Any], label: str, warnings: list[str]) -> float:
    if "d" in values:
        return float(
            np.clip(_floats(values["d"].replace("-halo", ""), 1, (1.0,), f"{label}: d", warnings)[0], 0.0, 1.0)
        )
    transparency = _floats(values.get("tr"), 1, (0.0,), f"{label}: Tr", warnings)[0]
    if transparency >= 1.0:
        warnings.append(f"{label}: Tr 1 without d taken as opaque")
        return 1.0
    return float(np.clip(1.0 - transparency, 0.0, 1.0))


def _texture(values: dict[str, Any], label: str, folder: ModelFolder, warnings: list[str]) -> PIL.Image.Image | None:
    """The colours of `map_Kd` with the opacity of `map_d`; white where there is only opacity."""
    image = _image(
        values.get("map_kd") or values.get("map_ka"), f"{label}: drawn without its texture", folder, warnings
    )
    mask = _image(values.get("map_d"), f"{label}: drawn without its opacity map", folder, warnings)
    colour = None if image is None else convert_image(image, "RGB")
    opacity = None if mask is None else convert_image(mask, "RGBA")
    if opacity is None:
        return colour
    alpha = opacity.getchannel("A") if opacity.mode == "RGBA" else opacity.convert("L")
    colour = PIL.Image.new("RGB", alpha.size, "white") if colour is None else colour
    size = max(colour.width, alpha.width), max(colour.height, alpha.height)
    colour = colour.resize(size)
    colour.putalpha(alpha.resize(size))
    return colour


def _image(name: str | None, what: str, folder: ModelFolder, warnings: list[str]) -> PIL.Image.Image | None:
    if not name:
        return None
    try:
        image = PIL.Image.open(io.BytesIO(folder.get_image(name)), formats=IMAGE_FORMATS)
        image.load()
    except FileNotFoundError:
        warnings.append(f"{what} {name} ({folder.lost.get(name, 'not found')})")
        return None
    except (OSError, SyntaxError, ValueError) as error:
        warnings.append(f"{what} {name}, which cannot be decoded: {error}")
        return None
    return image


def _floats(text: str | None, count: int, default: tuple[float, ...], what: str, warnings: list[str]) -> Any:
    if text is None:
        return np.array(default)
    try:
        found = np.array([float(value) for value in text.partition("#")[0].split()[:count]])
        if len(found) == 1 and count == 3:
            found = found.repeat(3)
        if len(found) == count and np.isfinite(found).all():
            return found
    except ValueError:
        pass
    warnings.append(f"{what}: expected {count} numbers, found {text!r}; {default} taken")
    return np.array(default)
