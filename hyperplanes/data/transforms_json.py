"""transforms.json: nerfstudio's, Blender's (NeRF synthetic) and the native one, to posed pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.data.bounds import stated_bounds
from hyperplanes.data.images import image_size, read_image
from hyperplanes.data.posed import Posed, PosedTask, check_pose, posed
from hyperplanes.data.transforms_document import calibration, opencv_from_opengl
from hyperplanes.data.undistort import distortion, undistort
from hyperplanes.files import DataError, inside, read_json
from hyperplanes.geometry.rays import Sphere

__all__ = ["find_transforms", "read_transforms", "read_transforms_task"]

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".webp")


@dataclass(frozen=True)
class _Frame:
    fields: dict[str, Any]
    name: str
    path: Path


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
    only: Sequence[str] | None = None,
    legacy: bool = False,
    bounds: Sphere | None = None,
    flat: bool = False,
) -> Posed:
    """The posed pictures of one scene.

    Distorted pictures (k1, k2, k3, p1, p2 not zero) are undistorted with the same calibration. An alpha channel, or the
    pictures that `mask_path` names, become the masks.

    Args:
        path: a transforms file, or several of one folder that are read as one scene.
        only: the `file_path`s to read, in this order; all when None.
        legacy: as in `calibration`.
        bounds: of the scene; "scene_sphere" of the file, else an estimate, when None.
        flat: take only the last part of each `file_path`, beside the file, as learnit's data have it.

    Returns:
        The pictures of all frames in the order of the files. Anything wrong with a file is a DataError that names it.
    """
    paths = [Path(path)] if isinstance(path, (str, Path)) else list(path)
    documents = [read_json(one) for one in paths]
    frames = [frame for one, document in zip(paths, documents, strict=True) for frame in _frames(one, document, flat)]
    if only is not None:
        frames = _chosen(frames, only, paths[0])
    source = frames[0].path.parent if len(paths) > 1 else paths[0]
    size = image_size(frames[0].path)
    pictures, alphas, matrices, poses = [], [], [], []
    for frame in frames:
        poses.append(check_pose(frame.fields.get("transform_matrix"), paths[0], frame.name))
        matrix = calibration(frame.fields, size, paths[0], legacy=legacy)
        picture, alpha = _picture(frame, size, paths[0].parent)
        coefficients = distortion(frame.fields, paths[0])
        if any(coefficients):
            picture = undistort(picture, matrix, coefficients, opaque=not alpha)
        pictures.append(picture)
        matrices.append(matrix)
        alphas.append(alpha)
    return posed(
        pictures,
        opencv_from_opengl(np.stack(poses)),
        np.stack(matrices),
        has_alpha=any(alphas),
        bounds=bounds or stated_bounds(documents[0], paths[0]),
        names=tuple(frame.name for frame in frames),
        source=source,
    )


def read_transforms_task(
    folder: str | Path, name: str, *, legacy: bool = False, bounds: Sphere | None = None, flat: bool = False
) -> PosedTask:
    """Support and query of one scene.

    transforms_train.json is the support and transforms_test.json (or _val) the query where they are; in one
    transforms.json, `train_filenames` and `test_filenames` decide; else views alternate, the first one support.

    Args:
        folder: what holds the files.
        name: of the object.
        legacy: as in `calibration`.
        bounds: as in `read_transforms`; an estimate uses all views of the support.
        flat: as in `read_transforms`.

    Returns:
        The two halves with the same bounds.

    Raises:
        DataError: no transforms file, no view in one half, or anything wrong with a file.
    """
    files = find_transforms(folder)
    if not files:
        raise DataError(folder, "transforms.json or transforms_train.json", "neither", "check the path")
    settings: dict[str, Any] = {"legacy": legacy, "flat": flat}
    if len(files) > 1:
        support = read_transforms(files[0], bounds=bounds, **settings)
        query = read_transforms(files[-1], bounds=support.bounds, **settings)
        return _same_size(PosedTask(support, query, name), folder)
    document = read_json(files[0])
    halves = [document.get(f"{half}_filenames") for half in ("train", "test")]
    if not document.get("test_filenames") and isinstance(document.get("val_filenames"), list):
        halves[1] = document["val_filenames"]
    if not all(isinstance(half, list) and half for half in halves):
        scene = read_transforms(files[0], bounds=bounds, **settings)
        if len(scene) < 2:
            raise DataError(files[0], "two frames or more", f"{len(scene)}", "add views to support or to query")
        return PosedTask.alternating(scene, name)
    names = [*halves[0], *halves[1]]  # type: ignore[misc]
    if len(set(names)) < len(names):
        raise DataError(
            files[0], "train_filenames and test_filenames without common or repeated files", "some", "correct the file"
        )
    scene = read_transforms(files[0], only=names, bounds=bounds, **settings)
    count = len(halves[0])  # type: ignore[arg-type]
    return PosedTask(scene.select(list(range(count))), scene.select(list(range(count, len(names)))), name)


def _frames(path: Path, document: dict[str, Any], flat: bool) -> list[_Frame]:
    listed = document.get("frames")
    if not isinstance(listed, list) or not listed or not all(isinstance(frame, dict) for frame in listed):
        found = f"{len(listed)} of them" if isinstance(listed, list) else repr(listed)[:40]
        raise DataError(path, "frames, a list of one or more objects", found, "export the file again")
    common = {key: value for key, value in document.items() if key != "frames"}
    return [_frame(path, common, frame, flat) for frame in listed]


def _frame(path: Path, common: dict[str, Any], frame: dict[str, Any], flat: bool) -> _Frame:
    written = frame.get("file_path")
    if not isinstance(written, str) or not written:
        raise DataError(path, "a file_path in every frame", repr(written), "export the file again")
    located = inside(path.parent, PurePosixPath(written.replace("\\", "/")).name if flat else written, path)
    if not located.is_file():
        with_suffix = [located.with_name(located.name + suffix) for suffix in _SUFFIXES]
        located = next((candidate for candidate in with_suffix if candidate.is_file()), located)
    return _Frame(common | frame, written, located)


def _chosen(frames: list[_Frame], only: Sequence[str], path: Path) -> list[_Frame]:
    by_name = {str(PurePosixPath(frame.name)): frame for frame in frames}
    chosen = []
    for name in only:
        frame = by_name.get(str(PurePosixPath(name))) if isinstance(name, str) else None
        if frame is None:
            raise DataError(path, f"a frame for {name!r} of train_filenames, test_filenames", "none", "correct it")
        chosen.append(frame)
    return chosen


def _picture(frame: _Frame, size: tuple[int, int], folder: Path) -> tuple[npt.NDArray[np.uint8], bool]:
    picture, alpha = read_image(frame.path, size)
    mask = frame.fields.get("mask_path")
    if mask is not None and not alpha:
        values, _ = read_image(inside(folder, mask, folder), size)
        picture[..., 3] = values[..., :3].max(-1)
        alpha = True
    return picture, alpha


def _same_size(task: PosedTask, folder: str | Path) -> PosedTask:
    sizes = task.support.rgba.shape[2:], task.query.rgba.shape[2:]
    if sizes[0] != sizes[1]:
        raise DataError(folder, "train and test pictures of one size", f"{sizes}", "scale one of them")
    return task
