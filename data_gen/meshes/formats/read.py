"""Reads mesh files of any format, with checks and a single type of error."""

from __future__ import annotations

import contextlib
import logging
import warnings as python_warnings
from collections.abc import Generator

import trimesh

from data_gen.meshes.files import MeshError
from data_gen.meshes.formats.dae import read_dae
from data_gen.meshes.formats.gltf import read_gltf
from data_gen.meshes.formats.obj import read_obj
from data_gen.meshes.formats.off import read_off
from data_gen.meshes.formats.ply import read_ply
from data_gen.meshes.formats.stl import read_stl
from data_gen.meshes.materials import ColourSpace
from data_gen.meshes.model_folder import ModelFolder

__all__ = ["read_scene"]

_READERS = {".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl, ".dae": read_dae}


def read_scene(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, ColourSpace, list[str]]:
    """Read a mesh file of any format.

    Returns:
        A scene in the file's coordinates, the colour space of its plain colours, and warnings.

    Raises:
        MeshError: if the file is damaged, was cut, or is refused.
    """
    try:
        with _strict_loaders():
            found = _read(data, folder.path.suffix.lower(), folder)
    except MeshError as error:
        raise folder.refused or error from error
    except (Exception, MemoryError) as error:
        if folder.refused is not None:
            raise folder.refused from error
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise MeshError(
            f"{folder.path}: expected a whole mesh, found {reason}; the file is damaged or was cut"
        ) from error
    if folder.refused is not None:
        raise folder.refused
    return found


def _read(data: bytes, suffix: str, folder: ModelFolder) -> tuple[trimesh.Scene, ColourSpace, list[str]]:
    if suffix in (".glb", ".gltf"):
        return read_gltf(data, folder)
    scene, lines = _READERS[suffix](data, folder)
    return scene, "srgb" if suffix == ".dae" else "scene", lines


@contextlib.contextmanager
def _strict_loaders() -> Generator[None, None, None]:
    """Silence the loaders' log, and turn NumPy's warning that a text was not read to its end into an error."""
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore")
            python_warnings.filterwarnings("error", message="string or file could not be read to its end")
            yield
    finally:
        logger.setLevel(level)
