"""Sources of objects: procedural ones, or a folder of mesh files."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase as fnmatch
from pathlib import Path
from typing import Any, Literal

import numpy as np

from data_gen.meshes.files import STATES_ITS_AXIS

__all__ = ["Item", "Listing", "MeshFolder", "Procedural", "Source", "check_source", "list_items", "seed_of"]

MOST_OBJECTS = 1_000_000
"""Most objects of a data set; a larger manifest could not be read."""


@dataclass(frozen=True)
class Procedural:
    """Objects of a class of `data_gen.shapes`.

    Attributes:
        class_name: car, chair, plane, lamp or random.
        count: number of objects, including the held-out ones.
        seed: training objects are the first of one endless sequence, held-out ones of another. Both depend on the seed
            alone, so data sets of different sizes and one seed share objects. No object occurs twice in the two
            sequences, so training and held-out objects never mix.
    """

    class_name: str
    count: int
    seed: int = 0


@dataclass(frozen=True)
class MeshFolder:
    """The mesh files under a folder, or a ShapeNetCore tree.

    Attributes:
        path: the folder.
        up: the axis that is up, y or z, in formats that do not state it: OBJ, PLY, STL and OFF.
        up_of: exceptions as `PATTERN=AXIS`, for files of any format; the last that matches counts. The pattern is a
            folder, a file, or has wildcards (`scans/*.glb`), relative to `path`.
        class_name: of the meshes whose class the tree does not state; some layouts name folders by it.
        split_file: ShapeNet's official all.csv; models that it does not list are trained on, and the manifest names
            them.
    """

    path: str | Path
    up: Literal["y", "z"] = "y"
    split_file: str | Path | None = None
    up_of: tuple[str, ...] = ()
    class_name: str | None = None


Source = Procedural | MeshFolder


@dataclass(frozen=True)
class Item:
    """An object to be rendered.

    Attributes:
        name: a plain file name, unique in the data set.
        class_name: of the object, or None.
        split: "train", "val" or "test".
        seed: of the procedural shape, or None for a file.
        path: of the mesh file, or None for a procedural shape.
        source: the same relative to the folder of meshes.
        unlisted: whether the split file does not name it, so that it is trained on.
        up: the axis that points up in the file, y or z; None for that of the format.
    """

    name: str
    class_name: str | None
    split: str
    seed: int | None = None
    path: str | None = None
    source: str | None = None
    unlisted: bool = False
    up: Literal["y", "z"] | None = None


@dataclass(frozen=True)
class Listing:
    """The objects of a source.

    Attributes:
        items: the objects to be rendered, training ones first.
        unreadable: names of files in unsupported formats, with reasons.
        duplicates: names of files that hold one of the objects in another format, with reasons.
    """

    items: list[Item]
    unreadable: list[tuple[str, str]] = field(default_factory=list)
    duplicates: list[tuple[str, str]] = field(default_factory=list)


def check_source(source: Source, held_out: float | int | None) -> None:
    """Refuse a source for what it states, without looking for its files.

    An unknown class or axis, or a number that makes no sense, is a ValueError.

    Args:
        source: what would be listed.
        held_out: as in `list_items`.
    """
    if isinstance(source, Procedural):
        _check_procedural(source, held_out)
    else:
        _check_meshes(source, held_out)


def list_items(
    source: Source,
    held_out: float | int | None,
    reason_against: Callable[[Path], str | None] = lambda _: None,
) -> Listing:
    """All objects of a source, with their splits.

    Args:
        source: what to list.
        held_out: objects of each class in the test split: a count, a fraction below 1, or None for one in seven of
            procedural objects, and for mesh files the split that the tree states, else the last 20 % of each class by
            name (as in the paper's 200x200 data).
        reason_against: as in `find_meshes`.

    Returns:
        The objects. An unknown class or an invalid count is a ValueError.
    """
    check_source(source, held_out)
    procedural = isinstance(source, Procedural)
    listing = Listing(_procedural(source, held_out)) if procedural else _meshes(source, held_out, reason_against)
    order = {"train": 0, "val": 1, "test": 2}
    return replace(listing, items=sorted(listing.items, key=lambda item: (order[item.split], item.name)))


def seed_of(seed: int, *parts: object) -> int:
    """A 63-bit seed that depends on a seed and its purpose alone.

    >>> seed_of(0, "rig", "car_0000") == seed_of(0, "rig", "car_0000") != seed_of(1, "rig", "car_0000")
    True
    """
    digest = hashlib.sha256(repr((seed, *parts)).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def _check_procedural(source: Procedural, held_out: float | int | None) -> None:
    from data_gen.shapes import check_class

    check_class(source.class_name)
    if source.count < 1 or source.seed < 0:
        raise ValueError(
            f"count, seed: expected at least 1 object and a seed >= 0, got {source.count} and {source.seed}"
        )
    if source.count > MOST_OBJECTS:
        raise ValueError(f"count: expected at most {MOST_OBJECTS} objects, got {source.count}; make several data sets")
    _count_held_out(source, held_out)


def _count_held_out(source: Procedural, held_out: float | int | None) -> int:
    return _held_out(source.count, 1 / 7 if held_out is None else held_out)


def _procedural(source: Procedural, held_out: float | int | None) -> list[Item]:
    kept = _count_held_out(source, held_out)
    totals, taken, items = {"train": source.count - kept, "test": kept}, set(), []
    for index in range(max(totals.values())):
        for split, infix in (("train", ""), ("test", "test_")):
            seed = _draw(np.random.SeedSequence([source.seed, split == "test", index]), taken)
            if index < totals[split]:
                items.append(Item(f"{source.class_name}_{infix}{index:05d}", source.class_name, split, seed=seed))
    return items


def _draw(sequence: np.random.SeedSequence, taken: set[int]) -> int:
    """The first number of a sequence that no earlier object has, in data sets of any size.

    Numbers have 32 bits: among 77,000, two would be equal with a probability of one half.
    """
    words = 1
    while (seed := int(sequence.generate_state(words)[-1])) in taken:
        words += 1
    taken.add(seed)
    return seed


def _check_meshes(source: MeshFolder, held_out: float | int | None) -> None:
    from data_gen.meshes.find import safe_name

    if source.up not in ("y", "z"):
        raise ValueError(f"up: expected y or z, got {source.up!r}")
    if source.class_name is not None and safe_name(source.class_name) != source.class_name:
        raise ValueError(f"class_name: expected letters, digits, . - and _, got {source.class_name!r}")
    if source.split_file is not None and held_out is not None:
        raise ValueError(f"held_out: expected none, for {source.split_file} decides, got {held_out}")


def _meshes(source: MeshFolder, held_out: float | int | None, reason_against: Callable[[Path], str | None]) -> Listing:
    from data_gen.meshes.find import find_meshes

    found = find_meshes(source.path, split_file=source.split_file, reason_against=reason_against)
    if source.split_file is not None and not any(mesh.split for mesh in found.meshes):
        raise ValueError(f"{source.split_file}: expected models of {source.path}, found none of them; check both")
    axes = _axes(source, [mesh.path for mesh in found.meshes])
    stated = held_out is None and any(mesh.split for mesh in found.meshes)
    classes: dict[str | None, list[Any]] = defaultdict(list)
    for mesh in found.meshes:
        classes[mesh.class_name or source.class_name].append(mesh)
    items = []
    for class_name, meshes in classes.items():
        kept = _held_out(len(meshes), 0.2 if held_out is None else held_out)
        for index, mesh in enumerate(meshes):
            split = "test" if index >= len(meshes) - kept else "train"
            if stated:
                split = mesh.split or "train"
            unlisted = stated and mesh.split is None
            paths = {"path": str(mesh.path), "source": mesh.path.relative_to(source.path).as_posix()}
            items.append(Item(mesh.name, class_name, split, unlisted=unlisted, up=axes[mesh.path], **paths))
    return Listing(items, found.unreadable, found.duplicates)


def _axes(source: MeshFolder, paths: list[Path]) -> dict[Path, Any]:
    """The axis that is up in each file; None for that of the format."""
    axes: dict[Path, Any] = {path: None if path.suffix.lower() in STATES_ITS_AXIS else source.up for path in paths}
    names = {path: path.relative_to(source.path).as_posix() for path in paths}
    for exception in source.up_of:
        pattern, _, axis = exception.rpartition("=")
        if not pattern or axis not in ("y", "z"):
            raise ValueError(f"up_of: expected PATTERN=y or PATTERN=z, got {exception!r}")
        pattern = pattern.strip("/")
        chosen = [path for path, name in names.items() if fnmatch(name, pattern) or fnmatch(name, f"{pattern}/*")]
        if not chosen:
            raise ValueError(f"up_of: expected a file or folder of {source.path}, got {pattern!r}, which fits none")
        axes |= dict.fromkeys(chosen, axis)
    return axes


def _held_out(total: int, wanted: float | int) -> int:
    if isinstance(wanted, float) and 0 <= wanted < 1:
        return min(math.ceil(total * wanted - 1e-9), max(total - 1, 0))
    if not math.isfinite(wanted) or wanted != int(wanted) or not 0 <= wanted <= total:
        raise ValueError(f"held_out: expected a fraction below 1 or a count up to {total} of each class, got {wanted}")
    return int(wanted)
