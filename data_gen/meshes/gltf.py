"""Reads glTF and GLB files with trimesh, after checks: whole, without unsupported extensions, all its textures decoded.

trimesh alone ignores `extensionsRequired` (geometry compressed by Draco comes out as zeros), allocates whatever an
accessor counts, and drops a texture that it cannot decode without a warning. Its public loader takes bytes only, so the
JSON is parsed twice: here and there.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
import urllib.parse
from typing import Any

import numpy as np
import trimesh

from data_gen.meshes.files import MeshError
from data_gen.meshes.materials import DEFAULT_COLOUR, ColourSpace
from data_gen.meshes.model_folder import ModelFolder
from data_gen.meshes.mtl import decode_text

__all__ = ["read_gltf"]

_REMEDY = {
    "KHR_draco_mesh_compression": "export it without Draco compression",
    "EXT_meshopt_compression": "export it without meshopt compression",
    "KHR_meshopt_compression": "export it without meshopt compression",
    "KHR_mesh_quantization": "export it with float positions (no quantisation)",
    "EXT_mesh_gpu_instancing": "export it with its instances as nodes",
}
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_FINE_EXTENSIONS = {
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_emissive_strength",
    "EXT_texture_webp",
    "KHR_texture_transform",
    "KHR_lights_punctual",
}
_MODES = {0: "points", 1: "lines", 2: "lines", 3: "lines", 6: "triangle fans"}


def read_gltf(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, ColourSpace, list[str]]:
    """Read a glTF or GLB file whose buffers and textures have been checked.

    Args:
        data: the content of the file; GLB if the file is called so.
        folder: gives the other files of the model.

    Returns:
        Its scene; what its plain colours are (trimesh writes factors as sRGB); and warnings that name what will not be
        drawn as the file states.

    Raises:
        MeshError: if the file was cut, is malformed, or needs what is not supported.
    """
    suffix = folder.path.suffix.lower()
    try:
        header, chunk = _glb(data, folder) if suffix == ".glb" else (_json(data, folder), None)
        if not isinstance(header, dict):
            raise MeshError(f"{folder.path}: expected a glTF object, found {type(header).__name__}; export it again")
        warnings, untextured = _check(header, chunk, folder)
        by_trimesh = "trimesh" in str(header.get("asset", {}).get("generator", "")).lower()
    except MeshError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise MeshError(
            f"{folder.path}: expected a valid glTF, found {type(error).__name__} at {error}; export it again"
        ) from error
    scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
    for geometry in scene.geometry.values():
        material = getattr(getattr(geometry, "visual", None), "material", None)
        if material is not None and material.name in untextured:
            _set_default_colour(material)
    return scene, "scene" if by_trimesh else "gltf", warnings


def _set_default_colour(material: Any) -> None:
    """Grey for a white material whose texture is lost: white would not be seen over white."""
    factor = material.baseColorFactor
    white = factor is None or (np.asarray(factor)[:3] == 255).all()
    if white and getattr(material, "baseColorTexture", None) is None:
        material.baseColorFactor = DEFAULT_COLOUR


def _json(data: bytes, folder: ModelFolder) -> Any:
    try:
        return json.loads(decode_text(data))
    except (json.JSONDecodeError, RecursionError) as error:
        raise MeshError(f"{folder.path}: expected JSON, found {error}; the file is damaged or was cut") from error


def _glb(data: bytes, folder: ModelFolder) -> tuple[Any, bytes | None]:
    if len(data) < 20 or data[:4] != b"glTF":
        raise MeshError(
            f"{folder.path}: expected a GLB header, found {data[:4]!r} in {len(data)} bytes; export it again"
        )
    version, length, json_length, kind = struct.unpack("<4I", data[4:20])
    if version != 2 or kind != 0x4E4F534A:
        raise MeshError(f"{folder.path}: expected glTF version 2, found version {version}; export it as glTF 2")
    if length > len(data):
        raise MeshError(f"{folder.path}: expected {length} bytes, found {len(data)}: the file was cut; fetch it again")
    if 20 + json_length > length:
        raise MeshError(f"{folder.path}: expected its JSON within {length} bytes, found {json_length}; export it again")
    header = _json(data[20 : 20 + json_length], folder)
    start = 20 + json_length
    if start + 8 > length:
        return header, None
    (size,) = struct.unpack("<I", data[start : start + 4])
    if start + 8 + size > length:
        raise MeshError(f"{folder.path}: expected its buffer within {length} bytes, found {size}; export it again")
    return header, data[start + 8 : start + 8 + size]


def _check(header: dict[str, Any], chunk: bytes | None, folder: ModelFolder) -> tuple[list[str], set[str | None]]:
    warnings: list[str] = []
    used, required = set(header.get("extensionsUsed", [])), set(header.get("extensionsRequired", []))
    for name in sorted(used | required):
        if name in _REMEDY:
            raise MeshError(f"{folder.path}: expected a plain glTF, found {name}; {_REMEDY[name]}")
        if name in _FINE_EXTENSIONS:
            continue
        if name in required:
            raise MeshError(f"{folder.path}: expected a plain glTF, found the required {name}; export it without")
        if name.startswith(("KHR_materials", "KHR_texture")):
            warnings.append(f"{name}: drawn without it")
    buffers = _buffers(header, chunk, folder)
    _check_accessors(header, buffers, folder)
    without_texture = _check_textures(header, buffers, folder, warnings)
    _check_primitives(header, warnings, folder)
    return warnings, without_texture


def _buffers(header: dict[str, Any], chunk: bytes | None, folder: ModelFolder) -> list[bytes]:
    found = []
    for index, buffer in enumerate(header.get("buffers", [])):
        where = f"{folder.path}: buffer {index}"
        data = chunk if "uri" not in buffer else _uri(buffer["uri"], folder, where)
        if data is None:
            raise MeshError(f"{where}: expected its {buffer['byteLength']} bytes, found none; fetch the whole model")
        if len(data) < buffer["byteLength"]:
            raise MeshError(
                f"{where}: expected {buffer['byteLength']} bytes, found {len(data)}: it was cut; fetch it again"
            )
        found.append(data)
    return found


def _uri(uri: str, folder: ModelFolder, where: str, *, image: bool = False) -> bytes | None:
    if uri.startswith("data:"):
        _, _, text = uri.partition("base64,")
        try:
            return base64.b64decode(text, validate=True)
        except binascii.Error as error:
            raise MeshError(f"{where}: expected base64 data, found {error}; export it again") from error
    scheme = urllib.parse.urlsplit(uri).scheme
    if scheme in ("http", "https", "ftp"):
        raise MeshError(f"{where}: expected a file beside the mesh, found {uri}; nothing is fetched from the network")
    try:
        return folder.get_image(uri) if image else folder.read(uri)
    except FileNotFoundError:
        return None


def _check_accessors(header: dict[str, Any], buffers: list[bytes], folder: ModelFolder) -> None:
    views = header.get("bufferViews", [])
    for index, view in enumerate(views):
        start, length = view.get("byteOffset", 0), view["byteLength"]
        size = len(buffers[view["buffer"]]) if 0 <= view["buffer"] < len(buffers) else -1
        if start < 0 or length < 0 or start + length > size:
            raise MeshError(
                f"{folder.path}: bufferView {index}: expected bytes within its buffer of {max(size, 0)}, found "
                f"{start} to {start + length}; export it again"
            )
    for index, accessor in enumerate(header.get("accessors", [])):
        where = f"{folder.path}: accessor {index}"
        if "sparse" in accessor or "bufferView" not in accessor:
            raise MeshError(f"{where}: expected plain data, found a sparse or empty accessor; export it without")
        count = accessor["count"]
        item = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        view = views[accessor["bufferView"]]
        stride = view.get("byteStride", item)
        need = accessor.get("byteOffset", 0) + (max(count, 1) - 1) * stride + item
        if not isinstance(count, int) or count < 0 or stride < item or need > view["byteLength"]:
            raise MeshError(
                f"{where}: expected {count} items in {view['byteLength']} bytes, found that they need {need}; "
                "export it again"
            )


def _check_textures(
    header: dict[str, Any], buffers: list[bytes], folder: ModelFolder, warnings: list[str]
) -> set[str | None]:
    """Names of materials whose base colour texture is lost."""
    without_texture: set[str | None] = set()
    lost: dict[int, str] = {}
    for index, image in enumerate(header.get("images", [])):
        name = image.get("uri") or image.get("name") or f"image {index}"
        name = name if len(name) < 100 else f"image {index}"
        if image.get("mimeType") == "image/ktx2":
            lost[index] = f"{name} (KTX2 is not supported)"
            folder.lost.setdefault(name, "KTX2 is not supported")
            continue
        if "bufferView" in image:
            view = header["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            data: bytes | None = buffers[view["buffer"]][start : start + view["byteLength"]]
        else:
            data = _uri(image["uri"], folder, f"{folder.path}: {name}", image=True) if image.get("uri") else None
        if data is None:
            lost[index] = f"{name} ({folder.lost.get(image.get('uri', ''), 'not found')})"
            continue
        if "uri" not in image or image["uri"].startswith("data:"):
            try:
                folder.count_pixels(data, name)
            except FileNotFoundError:
                lost[index] = f"{name} ({folder.lost.get(name, 'not decoded')})"
    textures = header.get("textures", [])
    for index, material in enumerate(header.get("materials", [])):
        label = f"material {material.get('name', index)!r}"
        for slot, reference in _slots(material):
            if not 0 <= reference["index"] < len(textures):
                warnings.append(f"{label}: {slot} refers to a texture that is not there; drawn without")
                continue
            texture = textures[reference["index"]]
            source = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source", texture.get("source"))
            if source is None or source in lost:
                reason = "which has no image" if source is None else lost[source]
                warnings.append(f"{label}: drawn without its {slot} {reason}")
                if slot == "baseColorTexture":
                    without_texture.add(material.get("name"))
            if slot == "baseColorTexture" and reference.get("texCoord", 0) != 0:
                warnings.append(
                    f"{label}: its texture uses the coordinates TEXCOORD_{reference['texCoord']}; TEXCOORD_0 taken"
                )
            moved = reference.get("extensions", {}).get("KHR_texture_transform", {})
            if any(
                moved.get(key, plain) != plain
                for key, plain in (("offset", [0, 0]), ("rotation", 0), ("scale", [1, 1]))
            ):
                warnings.append(f"{label}: KHR_texture_transform of its {slot} is not applied")

    return without_texture


def _slots(material: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    places = {**material, **material.get("pbrMetallicRoughness", {})}
    return [(key, value) for key, value in places.items() if key.endswith("Texture") and isinstance(value, dict)]


def _check_primitives(header: dict[str, Any], warnings: list[str], folder: ModelFolder) -> None:
    accessors = header.get("accessors", [])
    for index, mesh in enumerate(header.get("meshes", [])):
        label = mesh.get("name") or f"mesh {index}"
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", 4)
            if mode not in (4, 5):
                warnings.append(f"{label}: {_MODES.get(mode, f'mode {mode}')} left out, only triangles are drawn")
            elif "POSITION" in primitive["attributes"]:
                corners = accessors[primitive.get("indices", primitive["attributes"]["POSITION"])]["count"]
                if mode == 4 and corners % 3:
                    raise MeshError(
                        f"{folder.path}: {label}: expected 3 corners a triangle, found {corners}; export it again"
                    )
            if primitive.get("targets"):
                warnings.append(f"{label}: drawn without its morph targets")
    if any("skin" in node and "mesh" in node for node in header.get("nodes", [])):
        warnings.append("drawn in the pose of its mesh, not of its skeleton")
