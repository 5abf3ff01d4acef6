"""Data sets of objects rendered by Blender: Objaverse as Zero-1-to-3 publishes it, and OmniObject3D.

Zero-1-to-3 (Liu et al., 2023): OBJECT/000.png with alpha beside OBJECT/000.npy, which holds camera_from_world (3, 4) in
Blender's axes. The focal length is 35 mm on a sensor width of 32 mm, and objects fill a unit cube. valid_paths.json
lists the objects; the last hundredth of the list is the test split.

OmniObject3D (Wu et al., 2023): CATEGORY/OBJECT/render/transforms.json beside images/. The first three objects of a
category are the test split, as in the authors' benchmarks.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from hyperplanes.data.formats.arrays import read_array
from hyperplanes.data.formats.catalogue import Catalogue, is_plain
from hyperplanes.data.formats.scenes.transforms_json import read_transforms
from hyperplanes.data.pictures.frames import Frame, Listing, assemble, centred_matrix
from hyperplanes.data.pictures.posed import Posed, PosedTask, check_pose
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.axes import flip_camera_axes
from hyperplanes.utilities.files.reading import DataError, list_files, malformed, read_text

__all__ = ["is_omniobject", "is_rendered", "objaverse", "omniobject", "read_omniobject", "read_rendered"]

FOCAL = 35 / 32  # in image widths
CUBE = Sphere((0.0, 0.0, 0.0), math.sqrt(3) / 2)  # around the unit cube
TEST_OBJECTS = 3  # test objects in a category of OmniObject3D
VALID = "valid_paths.json"
_LARGEST_ARRAY = 4096
_REMEDY = "download the object again"


def is_rendered(folder: Path) -> bool:
    """Whether a folder holds one object as Zero-1-to-3's script renders it."""
    return (folder / "000.png").is_file() and (folder / "000.npy").is_file()


def read_rendered(folder: Path, root: Path) -> Listing:
    """The posed images of one object of Objaverse; the world is Blender's, z up.

    Returns:
        The images in the order of their numbers.

    Raises:
        DataError: an image without its camera, or a malformed file.
    """
    frames = []
    for path in list_files(folder, {".png"}, root):
        camera = path.with_suffix(".npy")
        if not camera.exists():
            raise DataError(camera, f"the camera of {path.name}", "nothing", _REMEDY)
        pose = check_pose(read_array(camera, "an array (3, 4)", _LARGEST_ARRAY, root), camera, path.name)
        frames.append(Frame(path, path.name, flip_camera_axes(pose.T).T, partial(centred_matrix, FOCAL)))
    return Listing(frames, folder, bounds=CUBE)


def objaverse(folder: Path) -> Catalogue | None:
    """The catalogue of a folder of objects, with or without valid_paths.json; None if it is in another layout.

    Returns:
        The objects, all in the test split without valid_paths.json. Views alternate between support and query.

    Raises:
        DataError: valid_paths.json is not a list of plain names.
    """
    names = [child.name for child in sorted(folder.iterdir()) if child.is_dir() and is_rendered(child)]
    if not names:
        return None
    splits, skipped = {"train": (), "val": (), "test": tuple(names)}, ()
    if (path := folder / VALID).is_file():
        with malformed(path, "a list of names"):
            listed = json.loads(read_text(path, root=folder))
        if not isinstance(listed, list) or not all(isinstance(name, str) and is_plain(name) for name in listed):
            raise DataError(path, "a list of plain names of folders", repr(listed)[:60], "correct the list")
        cut = math.floor(len(listed) / 100 * 99)
        there = set(names)
        train, test = (tuple(name for name in part if name in there) for part in (listed[:cut], listed[cut:]))
        splits = {"train": train, "val": (), "test": test}
        if missing := len(listed) - len(train) - len(test):
            skipped = (f"{path}: skipped {missing} of {len(listed)} objects without a folder",)

    def read(name: str) -> PosedTask:
        return PosedTask.alternating(assemble(read_rendered(folder / name, folder))[0], name)

    return Catalogue("objaverse", splits, read, skipped=skipped)


def is_omniobject(folder: Path) -> bool:
    """Whether a folder holds one object of OmniObject3D's renderings."""
    return (folder / "render" / "transforms.json").is_file() and (folder / "render" / "images").is_dir()


def read_omniobject(folder: Path, downscale: int | None, root: Path) -> Posed:
    """The posed images of one object of OmniObject3D, CATEGORY/OBJECT; the world is Blender's, z up.

    The published images have a black background and no alpha. If every border pixel is black, the masks are the pixels
    that are not black. It raises DataError if a file is missing or malformed.
    """
    found = assemble(read_transforms(folder / "render" / "transforms.json", root=root), downscale)[0]
    found = replace(found, names=tuple(f"render/{name}" for name in found.names))
    border = torch.cat([found.rgba[:, :3, [0, -1]].flatten(1), found.rgba[:, :3, :, [0, -1]].flatten(1)], 1)
    if found.has_alpha or border.any():
        return found
    rgba = found.rgba.clone()
    rgba[:, 3] = rgba[:, :3].amax(1).clamp_max(1) * 255
    return replace(found, rgba=rgba, has_alpha=True)


def omniobject(folder: Path) -> Catalogue | None:
    """The catalogue of blender_renders/, of the folder above it, or of one category; None for another layout.

    Returns:
        The objects: the first three of each category in the test split, the others in the train split. Views alternate
        between support and query.
    """
    top = folder / "blender_renders" if (folder / "blender_renders").is_dir() else folder
    homes = {child.name: child for child in sorted(top.iterdir()) if child.is_dir() and is_omniobject(child)}
    paths = {top.resolve().name: homes} if homes else {}
    if not paths:
        for category in (child for child in sorted(top.iterdir()) if child.is_dir()):
            objects = {child.name: child for child in sorted(category.iterdir()) if child.is_dir()}
            if found := {name: path for name, path in objects.items() if is_omniobject(path)}:
                paths[category.name] = found
    if not paths:
        return None
    splits: dict[str, tuple[str, ...]] = {"train": (), "val": (), "test": ()}
    for found in paths.values():
        splits["test"] += tuple(found)[:TEST_OBJECTS]
        splits["train"] += tuple(found)[TEST_OBJECTS:]
    where = {name: path for found in paths.values() for name, path in found.items()}
    classes = {name: {"class": category} for category, found in paths.items() for name in found}

    def read(name: str) -> PosedTask:
        return PosedTask.alternating(read_omniobject(where[name], None, folder), name)

    return Catalogue("omniobject3d", splits, read, {"objects": classes})
