"""CO3D, version 2: frame_annotations.jgz beside the sequences of a category (Reizenstein et al., 2021).

Poses are PyTorch3D's: x_camera = x_world R + T, x left, y up, z forward. Calibrations are in normalised device
coordinates. Their unit is half of the shorter side for `ndc_isotropic`, and half of each side for
`ndc_norm_image_bounds`. The principal point is measured from the middle of the image, to the left and up. Paths are
relative to the folder of categories.
"""

from __future__ import annotations

import gzip
import json
import os
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.catalogue import SPLITS, Catalogue, is_plain
from hyperplanes.data.pictures.frames import Frame, Listing, assemble
from hyperplanes.data.pictures.posed import PosedTask, check_pose
from hyperplanes.utilities.files.reading import MALFORMED, DataError, check_link, check_regular, inside, read_json

__all__ = ["ANNOTATIONS", "catalogue", "is_sequence", "read_sequence"]

ANNOTATIONS = "frame_annotations.jgz"
SET_LISTS = "set_lists/set_lists_fewview_dev.json"
MAX_ANNOTATION_BYTES = 2**30
"""Largest size of the annotations in bytes, decompressed."""

_FLIP = np.diag([-1.0, -1.0, 1.0])  # x left, y up, z forward to x right, y down, z forward
_REMEDY = "download the category again"


def is_sequence(folder: Path) -> bool:
    """Whether a folder holds one sequence and lies beside the annotations of its category."""
    return (folder / "images").is_dir() and (folder.resolve().parent / ANNOTATIONS).is_file()


def read_sequence(folder: Path, root: Path) -> Listing:
    """The posed images of one sequence, CATEGORY/SEQUENCE, in the order of their frames, with the published masks.

    It raises DataError if a file is missing or malformed.
    """
    whole = folder.resolve()
    category = whole.parent
    check_link(category / ANNOTATIONS, root if category.is_relative_to(root.resolve()) else category)
    return _listing(whole, _annotations(category / ANNOTATIONS).get(whole.name, []), root)


def catalogue(folder: Path) -> Catalogue | None:
    """The catalogue of a folder of categories, or of one category; None if it has no annotations.

    Returns:
        The sequences that have a folder. A sequence is in the split of its frames in set_lists_fewview_dev.json: train,
        test or val, whichever comes first; without this list or an entry in it, it is in the test split. Views
        alternate between support and query.

    Raises:
        DataError: a malformed file, a sequence in two categories, or no folder of any sequence.
    """
    homes = [folder] if (folder / ANNOTATIONS).is_file() else []
    homes = homes or sorted(path.parent for path in folder.glob(f"*/{ANNOTATIONS}"))
    if not homes:
        return None
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    known: dict[str, tuple[Path, list[dict[str, Any]]]] = {}
    skipped = []
    for home in homes:
        check_link(home / ANNOTATIONS, folder)
        sequences = _annotations(home / ANNOTATIONS)
        present = [name for name in sorted(sequences) if is_plain(name) and (home / name).is_dir()]
        if len(present) < len(sequences):
            skipped.append(f"{home}: skipped {len(sequences) - len(present)} of {len(sequences)} sequences, no folder")
        split_of = _splits(home / SET_LISTS)
        for name in present:
            if name in known:
                raise DataError(home, "every sequence in one category", f"{name} in two", "give one category")
            known[name] = home, sequences[name]
            splits[split_of.get(name, "test")].append(name)
    if not known:
        raise DataError(folder, "the sequences that its annotations name", "none of their folders", _REMEDY)

    def read(name: str) -> PosedTask:
        home, frames = known[name]
        return PosedTask.alternating(assemble(_listing(home.resolve() / name, frames, folder))[0], name)

    classes = {name: {"class": home.resolve().name} for name, (home, _) in known.items()}
    return Catalogue(
        "co3d", {split: tuple(names) for split, names in splits.items()}, read, {"objects": classes}, tuple(skipped)
    )


def _splits(path: Path) -> dict[str, str]:
    """The split of each sequence, the first of train, test and val that lists a frame of it; empty without lists."""
    if not path.is_file():
        return {}
    document, result = read_json(path), {}
    for split in ("val", "test", "train"):
        for entry in document.get(split) or ():
            if not (isinstance(entry, list) and entry and isinstance(entry[0], str)):
                raise DataError(path, f"(sequence, frame, image) in {split}", repr(entry)[:60], _REMEDY)
            result[entry[0]] = split
    return result


def _annotations(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The frames of each sequence, in the order of their numbers."""
    check_regular(path)
    try:
        with gzip.open(path, "rb") as file:
            text = file.read(MAX_ANNOTATION_BYTES + 1)
        if len(text) > MAX_ANNOTATION_BYTES:
            raise DataError(path, f"at most {MAX_ANNOTATION_BYTES} bytes, unpacked", "more", "give a smaller category")
        listed = json.loads(text)
        sequences: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for frame in listed:
            sequences[frame["sequence_name"]].append(frame)
        for frames in sequences.values():
            frames.sort(key=lambda frame: frame["frame_number"])
    except DataError:
        raise
    except (*MALFORMED, OSError) as error:
        raise DataError(path, "a list of frames, compressed by gzip", f"{error}"[:200], _REMEDY) from error
    return dict(sequences)


def _listing(folder: Path, listed: list[dict[str, Any]], root: Path) -> Listing:
    """The images of a sequence, from its annotations. Their paths are relative to the folder of categories."""
    source, base = folder.parent / ANNOTATIONS, folder.parent.parent
    if not listed:
        raise DataError(source, f"frames of {folder.name}", "none", _REMEDY)
    frames = []
    for frame in listed:
        view, name = frame["viewpoint"], frame["image"]["path"]
        height, width = (int(value) for value in frame["image"]["size"])
        pose = np.eye(4)
        pose[:3, :3] = _FLIP @ np.array(view["R"], dtype=np.float64).T
        pose[:3, 3] = _FLIP @ np.array(view["T"], dtype=np.float64)
        mask = (frame.get("mask") or {}).get("path")
        found = inside(base, mask, source) if mask else None
        picture = inside(base, name, source)
        for path in (picture, found):
            if path is not None:
                check_link(path, root)
        frames.append(
            Frame(
                picture,
                Path(os.path.relpath(picture, folder)).as_posix(),
                check_pose(pose, source, name),
                partial(_calibration, view, source),
                (height, width),
                mask=found if found is not None and found.exists() else None,
            )
        )
    return Listing(frames, source)


def _calibration(view: dict[str, Any], source: Path, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """The calibration of an image of (height, width)."""
    half = np.array([size[1], size[0]]) / 2
    kind = view.get("intrinsics_format", "ndc_norm_image_bounds")
    if kind not in ("ndc_norm_image_bounds", "ndc_isotropic"):
        raise DataError(source, "ndc_isotropic or ndc_norm_image_bounds", repr(kind)[:40], _REMEDY)
    unit = half if kind == "ndc_norm_image_bounds" else half.min()
    x, y = np.array(view["focal_length"], dtype=np.float64) * unit
    centre = half - np.array(view["principal_point"], dtype=np.float64) * unit - 0.5
    return np.array([[x, 0.0, centre[0]], [0.0, y, centre[1]], [0.0, 0.0, 1.0]])
