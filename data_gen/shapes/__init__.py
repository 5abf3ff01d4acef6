"""An endless supply of procedural, ShapeNet-like objects: `make(class_name, seed)` always gives the same scene.

Frame: y up, front along +z (so +x is the object's left); `random` compositions have neither. Units are metres, and the
origin lies wherever the object stands or balances; rendering normalises objects.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
import trimesh

from data_gen.shapes.cars.car import car
from data_gen.shapes.chairs.chair import chair
from data_gen.shapes.lamps.lamp import lamp
from data_gen.shapes.parts import Part, build_scene
from data_gen.shapes.planes.plane import plane
from data_gen.shapes.random import composition
from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["CLASSES", "ONE_SIDED", "assemble", "check_class", "find_classes", "make"]

CLASSES: tuple[str, ...] = ("car", "chair", "plane", "lamp", "random")
"""Names of the classes of this package; the position of a name is part of its objects' seeds, so the order is fixed."""

ONE_SIDED: tuple[str, ...] = ("car", "chair", "plane", "lamp")
"""Classes whose solids never intersect themselves, so that inner sides are never visible and need not be drawn."""

_MAKERS: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "car": car,
    "chair": chair,
    "plane": plane,
    "lamp": lamp,
    "random": composition,
}


def find_classes() -> dict[str, Callable[[np.random.Generator], list[Part]]]:
    """The functions that make objects of each class: those of this package, then those of other installed packages.

    Another package adds a class by an entry point of the group `data_gen.shapes` that names such a function: it takes
    all randomness from the generator and returns painted solids in metres, y up, front along +z.
    """
    return _MAKERS | load_entries("data_gen.shapes", _MAKERS)


def check_class(class_name: str) -> None:
    """Check the name of a class.

    Raises:
        ValueError: an unknown name; the message has all classes and the nearest one.
    """
    known = find_classes()
    if class_name not in known:
        near = did_you_mean(class_name, known)
        raise ValueError(f"class: expected one of {', '.join(known)}, got {class_name!r}{near}")


def assemble(class_name: str, seed: int) -> list[Part]:
    """The painted solids of an object, before they are joined.

    Args:
        class_name: one of `find_classes`.
        seed: any non-negative integer; the same one gives the same parts.

    Returns:
        Parts in metres, y up, front along +z.

    Raises:
        ValueError: a negative seed, or an unknown class (`check_class`).
    """
    check_class(class_name)
    if seed < 0:
        raise ValueError(f"seed: expected a non-negative integer, got {seed}")
    number = CLASSES.index(class_name) if class_name in CLASSES else zlib.crc32(class_name.encode())
    return find_classes()[class_name](np.random.default_rng([number, seed]))


def make(class_name: str, seed: int) -> trimesh.Scene:
    """A procedural object.

    Args:
        class_name: one of `find_classes`.
        seed: any non-negative integer; the same one gives the same vertices, faces and pixels.

    Returns:
        A scene with one textured geometry per finish, the first named after the class: metres, y up, front along +z.
        Its `metadata["parts"]` lists (part name, first face, number of faces).
    """
    return build_scene(class_name, assemble(class_name, seed))
