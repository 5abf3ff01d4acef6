"""The JSON and the buffers of a glTF or GLB file, read completely and checked before use."""

from __future__ import annotations

import base64
import binascii
import json
import struct
import urllib.parse
from dataclasses import dataclass
from typing import Any

from data_gen.meshes.files import MeshError, decode_text
from data_gen.meshes.model_folder import ModelFolder

__all__ = ["Document", "not_negative", "open_document", "read_uri"]

_REMEDY = {
    "EXT_meshopt_compression": "export it without meshopt compression",
    "KHR_meshopt_compression": "export it without meshopt compression",
}
_DRAWN = {
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_materials_transmission",
    "KHR_texture_transform",
    "EXT_texture_webp",
    # These change nothing that is drawn here, or only highlights.
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_lights_punctual",
}


@dataclass(frozen=True)
class Document:
    """A glTF file whose buffers are in memory.

    Attributes:
        header: its JSON.
        buffers: the content of its buffers, each at least as long as declared.
        folder: gives the other files of the model, and names the file in messages.
        warnings: receives a line for everything that will not be drawn as the file states.
    """

    header: dict[str, Any]
    buffers: list[bytes]
    folder: ModelFolder
    warnings: list[str]

    @property
    def path(self) -> Any:
        """The file, for messages."""
        return self.folder.path

    def items(self, key: str) -> list[dict[str, Any]]:
        """A list of the header; empty if it has none of this name."""
        return self.header.get(key, [])

    def view(self, index: int) -> memoryview:
        """The bytes of a buffer view with checked bounds; not a copy."""
        view = self.items("bufferViews")[not_negative(index)]
        start = view.get("byteOffset", 0)
        return memoryview(self.buffers[view["buffer"]])[start : start + view["byteLength"]]


def not_negative(index: int) -> int:
    """An index in the file, checked: Python would count a negative one from the end.

    Raises:
        IndexError: if it is negative.
    """
    if index < 0:
        raise IndexError(f"index {index}")
    return index


def open_document(data: bytes, folder: ModelFolder) -> Document:
    """Parse the container (GLB by the file name), check its extensions, and read its buffers.

    Returns:
        The document; its buffer views lie inside their buffers.

    Raises:
        MeshError: if the file was cut, a buffer is missing, or a required extension is not supported.
    """
    header, chunk = _glb(data, folder) if folder.path.suffix.lower() == ".glb" else (_json(data, folder), None)
    if not isinstance(header, dict):
        raise MeshError(f"{folder.path}: expected a glTF object, found {type(header).__name__}; export it again")
    version = str(header.get("asset", {}).get("version", "2.0"))
    if version.partition(".")[0] != "2":
        raise MeshError(f"{folder.path}: expected glTF version 2, found version {version}; export it as glTF 2")
    warnings = _check_extensions(header, folder)
    document = Document(header, _buffers(header, chunk, folder), folder, warnings)
    _check_views(document)
    return document


def _check_extensions(header: dict[str, Any], folder: ModelFolder) -> list[str]:
    """Warnings about extensions that are not drawn; a MeshError if one is required."""
    warnings = []
    used, required = set(header.get("extensionsUsed", [])), set(header.get("extensionsRequired", []))
    for name in sorted(used | required):
        if name in _REMEDY:
            raise MeshError(f"{folder.path}: expected a plain glTF, found {name}; {_REMEDY[name]}")
        if name in _DRAWN:
            continue
        if name in required:
            raise MeshError(f"{folder.path}: expected a plain glTF, found the required {name}; export it without")
        if name.startswith(("KHR_materials", "KHR_texture")):
            warnings.append(f"{name}: drawn without it")
    return warnings


def read_uri(uri: str, folder: ModelFolder, where: str, *, image: bool = False) -> bytes | None:
    """The bytes of a URI in the file: base64 data, or a file of the model.

    Args:
        uri: the URI.
        folder: gives the files.
        where: start of messages.
        image: whether it is a texture, which is decoded once as a check.

    Returns:
        The bytes; None for a missing file or a damaged texture.

    Raises:
        MeshError: if the data is not base64, or the URI leads outside the model's folder or to the network.
    """
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


def _buffers(header: dict[str, Any], chunk: bytes | None, folder: ModelFolder) -> list[bytes]:
    found = []
    for index, buffer in enumerate(header.get("buffers", [])):
        where, uri = f"{folder.path}: buffer {index}", buffer.get("uri")
        data = chunk if uri is None else read_uri(uri, folder, where)
        if data is None:
            missing = "" if uri is None else f" {uri} ({folder.lost.get(uri, 'not found')})"
            raise MeshError(
                f"{where}{missing}: expected its {buffer['byteLength']} bytes, found none; fetch the whole model"
            )
        if len(data) < buffer["byteLength"]:
            raise MeshError(
                f"{where}: expected {buffer['byteLength']} bytes, found {len(data)}: it was cut; fetch it again"
            )
        found.append(data)
    return found


def _check_views(document: Document) -> None:
    for index, view in enumerate(document.items("bufferViews")):
        start, length = view.get("byteOffset", 0), view["byteLength"]
        size = len(document.buffers[view["buffer"]]) if 0 <= view["buffer"] < len(document.buffers) else -1
        if start < 0 or length < 0 or start + length > size:
            raise MeshError(
                f"{document.path}: bufferView {index}: expected bytes within its buffer of {max(size, 0)}, found "
                f"{start} to {start + length}; export it again"
            )
