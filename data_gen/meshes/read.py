"""Reads a mesh file of any format: the check that belongs to it, then its reader, and one kind of error from all."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings as python_warnings
from collections.abc import Generator

import numpy as np
import trimesh

from data_gen.meshes.files import MeshError
from data_gen.meshes.formats import check_stl, read_dae, read_off, read_ply
from data_gen.meshes.gltf import check_gltf, generator_of
from data_gen.meshes.materials import DEFAULT_COLOUR, ColourSpace
from data_gen.meshes.model_folder import ModelFolder
from data_gen.meshes.obj import read_obj

__all__ = ["read_scene"]


def read_scene(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, ColourSpace, list[str]]:
    """Read a mesh file of any format.

    Args:
        data: the content of the file.
        folder: names the file and gives the others of its model.

    Returns:
        A scene in the file's coordinates, what its plain colours are, and warnings.

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
    if suffix == ".obj":
        scene, lines = read_obj(data, folder)
        return scene, "scene", lines
    if suffix == ".off":
        scene, lines = read_off(data, folder)
        return scene, "scene", lines
    if suffix == ".ply":
        scene, lines = read_ply(data, folder)
        return scene, "scene", lines
    if suffix == ".dae":
        scene, lines = read_dae(data, folder)
        return scene, "srgb", lines
    lines, without_texture = (check_stl(data, folder), set()) if suffix == ".stl" else check_gltf(data, folder)
    scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
    _set_default_colour(scene, without_texture)
    if suffix == ".stl":
        for geometry in scene.geometry.values():
            geometry.metadata["smooth"] = False
    factors_are_srgb = suffix == ".stl" or "trimesh" in generator_of(data)
    return scene, "scene" if factors_are_srgb else "gltf", lines


def _set_default_colour(scene: trimesh.Scene, names: set[str | None]) -> None:
    """Give white materials that lost their texture the default colour: white on white would be lost to the eye too."""
    for geometry in scene.geometry.values():
        material = getattr(getattr(geometry, "visual", None), "material", None)
        if material is None or material.name not in names or getattr(material, "baseColorTexture", None) is not None:
            continue
        factor = material.baseColorFactor
        if factor is None or (np.asarray(factor)[:3] == 255).all():
            material.baseColorFactor = DEFAULT_COLOUR


@contextlib.contextmanager
def _strict_loaders() -> Generator[None, None, None]:
    """Keep the loaders' log quiet, and turn numpy's remark that a text was not read to its end into an error."""
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
