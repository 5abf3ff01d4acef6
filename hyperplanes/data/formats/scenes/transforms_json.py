"""Read posed images from transforms.json: nerfstudio's, Blender's (NeRF synthetic) and that of native data sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from hyperplanes.data.formats.calibration import brown_lens
from hyperplanes.data.formats.scenes.transforms_document import calibration, number, opencv_from_opengl, stated_size
from hyperplanes.data.pictures.bounds import stated_bounds
from hyperplanes.data.pictures.frames import Frame, Listing, assemble
from hyperplanes.data.pictures.images import image_size
from hyperplanes.data.pictures.masks import find_masks
from hyperplanes.data.pictures.posed import PosedTask, check_pose
from hyperplanes.data.pictures.undistort import COEFFICIENTS
from hyperplanes.data.upright import stated_up
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError, check_link, inside, read_json

__all__ = ["find_transforms", "read_transforms", "read_transforms_task"]

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".webp")


def find_transforms(folder: str | Path) -> list[Path]:
    """The transforms files of a folder: transforms.json alone, or transforms_train.json, _val and _test.

    >>> find_transforms("no such folder")
    []
    """
    folder = Path(folder)
    if (folder / "transforms.json").is_file():
        return [folder / "transforms.json"]
    names = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
    return [folder / name for name in names if (folder / name).is_file()]


def read_transforms(
    path: str | Path | Sequence[Path],
    *,
    legacy: bool = False,
    bounds: Sphere | None = None,
    root: Path | None = None,
) -> Listing:
    """The posed images of one scene.

    Images with distortion coefficients (k1 to k6, p1, p2) are undistorted with the same calibration. Masks are the
    alpha channel, the images that `mask_path` names, or those in a folder masks/ beside the file.

    Args:
        path: a transforms file, or several files of one folder that are read as one scene.
        legacy: as in `calibration`.
        bounds: of the scene; if None, "scene_sphere" of the file.
        root: no image may lie outside it, symbolic links followed; if None, the file's folder.

    Returns:
        The images of all frames in the order of the files. Raises a DataError that names a malformed file.
    """
    paths = [Path(path)] if isinstance(path, (str, Path)) else list(path)
    return _listed(paths, legacy, bounds, root)[0]


def read_transforms_task(
    path: str | Path,
    name: str,
    *,
    legacy: bool = False,
    bounds: Sphere | None = None,
    downscale: int | None = None,
    complete: bool = False,
    root: Path | None = None,
) -> PosedTask:
    """Support and query of one scene.

    transforms_train.json is the support and transforms_test.json (or _val) the query, if these files exist. A single
    transforms.json is split by its `train_filenames` and `test_filenames` (or `val_filenames`). Without these, views
    alternate between support and query, beginning with support.

    Args:
        path: the folder that holds the files, or a single file.
        name: of the object.
        legacy: as in `calibration`.
        bounds: as in `read_transforms`; an estimate uses the views of the support alone.
        downscale: as in `assemble`.
        complete: as in `assemble`.
        root: as in `read_transforms`.

    Returns:
        The two halves with the same bounds.

    Raises:
        DataError: no transforms file, no view in one half, or a malformed file.
    """
    files = [path] if (path := Path(path)).is_file() else find_transforms(path)
    if not files:
        raise DataError(path, "transforms.json or transforms_train.json", "neither", "check the path")
    paths = files if len(files) == 1 else [files[0], files[-1]]
    listing, document, count = _listed(paths, legacy, bounds, root)
    query = range(count, len(listing.frames))
    if len(paths) == 1:
        frames, query = _split_by_names(document, listing.frames, files[0])
        listing = replace(listing, frames=frames)
    scene, kept = assemble(listing, downscale, complete=complete)
    if query is None:
        return PosedTask.alternating(scene, name)
    halves = [[at for at, index in enumerate(kept) if (index in query) == asked] for asked in (False, True)]
    if not all(halves):
        found = f"{len(halves[0])} to train and {len(halves[1])} to test on"
        remedy = "copy the images to the paths that the files state, each in only one split"
        raise DataError(listing.source, "images of both splits", found, remedy)
    return PosedTask.split(scene, halves[0], halves[1], name)


def _split_by_names(
    document: dict[str, Any], frames: Sequence[Frame], path: Path
) -> tuple[Sequence[Frame], range | None]:
    """The frames that train_filenames and test_filenames name, and which of them are the query; None without lists."""
    halves = [document.get(f"{half}_filenames") for half in ("train", "test")]
    if not document.get("test_filenames") and isinstance(document.get("val_filenames"), list):
        halves[1] = document["val_filenames"]
    support, query = halves
    if not (isinstance(support, list) and support and isinstance(query, list) and query):
        return frames, None
    names = [*support, *query]
    if not all(isinstance(name, str) for name in names):
        raise DataError(path, "names of files in train_filenames and test_filenames", "others", "correct the file")
    return _chosen(document, frames, names, path), range(len(support), len(names))


def _listed(
    paths: list[Path], legacy: bool, bounds: Sphere | None, root: Path | None
) -> tuple[Listing, dict[str, Any], int]:
    """What all files list, the content of the first file, and its number of frames."""
    documents = [read_json(one, root or one.parent) for one in paths]
    parts = [_frames(path, document, legacy, root) for path, document in zip(paths, documents, strict=True)]
    first, document = paths[0], documents[0]
    listing = Listing(
        [frame for part in parts for frame in part],
        first if len(paths) == 1 else first.parent,
        bounds or stated_bounds(document, first),
        stated_up(document, first),
    )
    return listing, document, len(parts[0])


def _frames(path: Path, document: dict[str, Any], legacy: bool, root: Path | None) -> list[Frame]:
    """The frames of a file; masks are those that it names, otherwise those in masks/ beside it."""
    listed = document.get("frames")
    if not isinstance(listed, list) or not listed or not all(isinstance(frame, dict) for frame in listed):
        found = f"{len(listed)} of them" if isinstance(listed, list) else repr(listed)[:40]
        raise DataError(path, "frames, a list of one or more objects", found, "export the file again")
    common = {key: value for key, value in document.items() if key != "frames"}
    frames = [_frame(path, common | frame, legacy, root or path.parent) for frame in listed]
    if any(frame.mask is not None for frame in frames):
        return frames
    masks = find_masks([path.parent / "masks"], [frame.path for frame in frames], root or path.parent)
    return [replace(frame, mask=mask) for frame, mask in zip(frames, masks, strict=True)]


def _frame(path: Path, fields: dict[str, Any], legacy: bool, root: Path) -> Frame:
    """One frame of a file, from its own fields and those of the document."""
    written = fields.get("file_path")
    if not isinstance(written, str) or not written:
        raise DataError(path, "a file_path in every frame", repr(written), "export the file again")
    beside, as_written = path.parent / PurePosixPath(written.replace("\\", "/")).name, True
    try:
        located = _located(path, written, root)
    except DataError:  # outside the root: the image may have been copied beside the file
        if not any(beside.with_name(beside.name + suffix).is_file() for suffix in ("", *_SUFFIXES)):
            raise
        located, as_written = beside, False
    if not located.is_file():
        homes = located.parent, located.parent / "images", path.parent  # as written, as in OmniObject3D, as in learnit
        candidates = [home / (located.name + suffix) for home in homes for suffix in ("", *_SUFFIXES)]
        located = next((candidate for candidate in candidates if candidate.is_file()), located)
        check_link(located, root)
        as_written &= located.parent == homes[0]
    name = written if as_written else located.relative_to(path.parent).as_posix()
    pose = check_pose(fields.get("transform_matrix"), path, written)
    mask = fields.get("mask_path")
    return Frame(
        located,
        name,
        opencv_from_opengl(pose[None])[0],
        lambda size: calibration(fields, size, path, legacy=legacy),
        stated_size(fields, path),
        _lens(fields, located, path),
        None if mask is None else _located(path, mask, root),
    )


def _lens(fields: dict[str, Any], picture: Path, path: Path) -> tuple[float, ...]:
    """OpenCV's distortion coefficients of a frame.

    k4 is the coefficient of r^8 in Brown's model, as in nerfstudio, unless the camera has OpenCV's rational model.
    """
    stated = tuple(number(fields, name, 0.0, path) for name in COEFFICIENTS)
    k1, k2, p1, p2, k3, k4, k5, k6 = stated
    if not k4 or k5 or k6 or fields.get("camera_model") == "FULL_OPENCV":
        return stated
    height, width = size = stated_size(fields, path) or image_size(picture)
    matrix = calibration(fields, size, path)
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    reach = np.linalg.norm((corners - matrix[:2, 2]) / matrix.diagonal()[:2], axis=1).max()
    return brown_lens((k1, k2, k3, k4), (p1, p2), float(reach), path)


def _located(path: Path, name: object, root: Path) -> Path:
    """The path of a name in a file. The name must stay in the file's folder, and a symbolic link in the root."""
    text = name.replace("\\", "/") if isinstance(name, str) else ""
    if ".." in PurePosixPath(text).parts or root == path.parent:
        return inside(path.parent, name, path)  # type: ignore[arg-type]
    return inside(root, str(path.parent.relative_to(root) / text) if text else "", path)


def _chosen(document: dict[str, Any], frames: Sequence[Frame], only: Sequence[str], path: Path) -> list[Frame]:
    """The frames with given names, in the order of these."""
    listed = zip(document["frames"], frames, strict=True)
    by_name = {str(PurePosixPath(each["file_path"])): frame for each, frame in listed}
    chosen = []
    for name in only:
        frame = by_name.get(str(PurePosixPath(name)))
        if frame is None:
            raise DataError(path, f"a frame for {name!r} of train_filenames, test_filenames", "none", "correct it")
        chosen.append(frame)
    return chosen
