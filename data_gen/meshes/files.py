"""The files of a mesh: their limits (formats, bytes, pixels), their bytes and text, and the error for refused meshes.

Sizes are checked before a file is read, pixels before they are decoded.
"""

from __future__ import annotations

import codecs
import io
import warnings
from pathlib import Path

import PIL.Image

from hyperplanes.utilities.messages.errors import one_line

__all__ = [
    "IMAGE_FORMATS",
    "MAX_FILE_BYTES",
    "MAX_PARTS",
    "MAX_PIXELS",
    "MAX_TEXT_BYTES",
    "MESH_SUFFIXES",
    "OTHER_SUFFIXES",
    "STATES_ITS_AXIS",
    "UNFINISHED",
    "MeshError",
    "check_image",
    "decode_text",
    "read_bytes",
]

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".dae")
"""Endings of mesh files, lower case."""

OTHER_SUFFIXES = (
    *(".3ds", ".3mf", ".abc", ".blend", ".c4d", ".fbx", ".lwo", ".ma", ".max", ".mb", ".skp", ".stp", ".step"),
    *(".usd", ".usda", ".usdc", ".usdz", ".vrm", ".wrl", ".x3d"),
)
"""Endings of unsupported mesh files, lower case."""

STATES_ITS_AXIS = (".glb", ".gltf", ".dae")
"""Endings of formats that define the up axis: glTF y, by its specification, COLLADA in the file."""

MAX_FILE_BYTES = 1 << 30
"""Most bytes of one file."""

MAX_TEXT_BYTES = 1 << 28
"""Most bytes of a text file (OBJ, MTL, OFF, DAE), which takes about twenty times as many in memory."""

MAX_PIXELS = 1 << 26
"""Most pixels of all textures of a model, decoded: 8192 x 8192."""

MAX_PARTS = 20_000
"""Most parts of a mesh: primitives times the nodes and instances that place them. A part takes about 2 ms."""

IMAGE_FORMATS = ("PNG", "JPEG", "BMP", "GIF", "TIFF", "TGA", "WEBP", "PPM", "DDS", "JPEG2000")
"""Texture formats that are decoded, by Pillow's names; none of them starts a program."""

UNFINISHED = "the last line does not end: the file may have been cut"
"""The warning about a text file without an end of its last line."""


class MeshError(ValueError):
    """A mesh that is refused. The message is one line: file, expected, found, remedy."""


def read_bytes(path: Path, *, limit: int) -> bytes:
    """Read a file of at most `limit` bytes, whose size is checked first.

    Returns:
        The content.

    Raises:
        MeshError: if the file is absent, unreadable, empty or larger than the limit.
    """
    try:
        if not path.is_file():
            raise MeshError(f"{path}: expected a mesh file, found {'a folder' if path.is_dir() else 'nothing'}")
        size = path.stat().st_size
        if size > limit:
            raise MeshError(f"{path}: expected at most {limit} bytes, found {size}; reduce the mesh or its textures")
        if size == 0:
            raise MeshError(f"{path}: expected a mesh, found an empty file; fetch or export it again")
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: expected a readable file, found {error.strerror or error}") from error


def decode_text(data: bytes) -> str:
    """Text of a file without declared encoding: UTF-16 with a byte order mark, UTF-8, else Latin-1."""
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def check_image(data: bytes, name: str, *, limit: int) -> int:
    """Check that an image is intact by decoding it, after checking its size.

    Returns:
        Its number of pixels.

    Raises:
        MeshError: if it has more pixels than allowed.
        ValueError: if it is not an image, or cut short.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PIL.Image.DecompressionBombWarning)
            with PIL.Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as image:
                pixels = image.width * image.height
                if pixels > limit:
                    raise MeshError(
                        f"{name}: expected textures of at most {limit} pixels together, found one of "
                        f"{image.width} x {image.height}; make the texture smaller"
                    )
                image.load()
    except MeshError:
        raise
    except PIL.Image.DecompressionBombError as error:
        raise MeshError(f"{name}: expected at most {limit} pixels, found a decompression bomb: {error}") from error
    except PIL.UnidentifiedImageError as error:
        raise ValueError("not a whole image of a known format") from error
    except Exception as error:
        raise ValueError(f"not a whole image ({one_line(error)[:160]})") from error
    return pixels
