"""Find photographs, read their headers, group them by camera, and read them upright and scaled."""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from hyperplanes.data.formats.unposed import find_video, photographs_folder
from hyperplanes.data.pictures.images import (
    HEIF_SUFFIXES,
    PICTURE_SUFFIXES,
    image_header,
    read_image,
    read_mask,
    turned,
    without_haze,
)
from hyperplanes.data.pictures.masks import match_masks
from hyperplanes.utilities.files.order import natural_order
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.images.sizes import scaled_size
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.utilities.messages.formatting import counted

__all__ = ["MIN_PHOTOGRAPHS", "Photograph", "find_photographs", "list_photographs", "read_upright", "without_copies"]

MIN_PHOTOGRAPHS = 3
"""Least number of photographs from which poses can be found."""

_LOOKED_AT = 1000  # most entries of a folder that are searched
_MAKE, _MODEL, _EXIF = 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_35, _PIXELS_X = 0x920A, 0xA405, 0xA002
_PLANE_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0}  # millimetres, by EXIF's number of the unit
_FULL_FRAME = 36.0  # millimetres: the longer side of the film that 35 mm equivalents refer to
_SCALED_MASK = 1.02  # largest ratio of the aspect ratios of a mask and its photograph


@dataclass(frozen=True)
class Photograph:
    """One photograph, of which only the header has been read.

    Attributes:
        path: the file.
        name: a plain name without suffix, unique in the capture.
        size: (height, width) when upright.
        orientation: EXIF's orientation, 1 if the pixels are stored upright.
        camera: identifies the camera: make, model, focal length, longer and shorter side.
        focal: focal length in units of the longer side, None if EXIF does not state it.
        turned: whether the capture stores it rotated by 90 degrees counterclockwise, so that it has the same format,
            landscape or portrait, as most photographs of its camera.
        mask: the file of its mask, or None.
    """

    path: Path
    name: str
    size: tuple[int, int]
    orientation: int
    camera: str
    focal: float | None
    turned: bool = False
    mask: Path | None = None

    @property
    def up_in_camera(self) -> tuple[float, float, float]:
        """The up direction in the camera of the image that the capture stores: x right, y down, z forward."""
        return (-1.0, 0.0, 0.0) if self.turned else (0.0, -1.0, 0.0)


def find_photographs(folder: Path) -> list[Path]:
    """The photographs of a folder, or of one such as images/ in it, sorted by name.

    Numbers in names are sorted as numbers, so that IMG_9 comes before IMG_10.

    Raises:
        DataError: fewer than three photographs, or HEIC photographs if pillow-heif is not installed.
    """
    home = photographs_folder(folder)
    files = [] if home is None else [p for p in home.iterdir() if p.is_file() and not p.name.startswith(".")]
    heif = [path for path in files if path.suffix.lower() in HEIF_SUFFIXES]
    if heif and not _reads_heif():
        raise DataError(
            heif[0], "JPEG, PNG, WebP or TIFF", "HEIC", "pip install pillow-heif, or have the phone save JPEG"
        )
    pictures = heif + [path for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
    found = sorted(pictures, key=lambda path: natural_order(path.name))
    if len(found) < MIN_PHOTOGRAPHS:
        wanted = f"at least {MIN_PHOTOGRAPHS} photographs of one object"
        raise DataError(folder, wanted, counted(len(found), "photograph"), _elsewhere(folder))
    return found


def _elsewhere(folder: Path) -> str:
    """What to do about too few photographs. The user may have meant a folder or a video inside the given folder."""
    children = sorted(child for _, child in zip(range(_LOOKED_AT), folder.iterdir(), strict=False))
    for child in children:
        if child.name != "masks" and child.is_dir() and (home := photographs_folder(child)):
            return f"there are some in {home}: give that folder"
    if (video := find_video(folder)) is not None:
        return f"there is a video in it: give {video}"
    return "40 to 75 from all around are a good number"


def list_photographs(paths: Sequence[Path], masks: Path | None = None) -> tuple[list[Photograph], list[str]]:
    """Photographs from their headers, without decoding them.

    Args:
        paths: the files.
        masks: a folder of masks that are matched as by `match_masks`, or None.

    Returns:
        The photographs whose headers can be read, and a note about each of the others.
    """
    found, notes = [], []
    names = set[str]()
    given = match_masks(masks, paths) if masks is not None else None
    for index, path in enumerate(paths):
        try:
            header = image_header(path)
            tags = _exif(path)
        except DataError as error:
            notes.append(f"left out: {error}")
            continue
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", path.stem).lstrip(".") or "photograph"
        name = next(each for each in chain([name], (f"{name}_{n}" for n in count(2))) if each not in names)
        names.add(name)
        longer, shorter = max(header.size), min(header.size)
        camera = " ".join(
            str(part).strip() for part in (tags.get(_MAKE, ""), tags.get(_MODEL, ""), tags.get(_FOCAL, ""))
        )
        camera = f"{camera} {longer}x{shorter}".strip()
        mask = None if given is None else given[index]
        focal = _focal(tags)
        found.append(Photograph(path, name, header.upright_size, header.orientation, camera, focal, mask=mask))
    return _with_one_shape(found), notes


def without_copies(photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[str]]:
    """The photographs without files that are byte-for-byte copies of earlier ones, and a note if there are any."""
    sizes = Counter(one.path.stat().st_size for one in photographs)
    seen: set[bytes] = set()
    kept, copies = [], []
    for one in photographs:
        if sizes[one.path.stat().st_size] > 1:
            digest = hashlib.sha256(one.path.read_bytes()).digest()
            if digest in seen:
                copies.append(one.path.name)
                continue
            seen.add(digest)
        kept.append(one)
    notes = [f"{len(copies)} of the files are copies of others and are left out: {listed(copies)}"] if copies else []
    return kept, notes


def read_upright(
    photograph: Photograph, max_size: int
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"] | None]:
    """The pixels of a photograph and its mask: upright, or rotated as `Photograph.turned` says.

    Both are scaled down if the longer side has more than `max_size` pixels.

    Returns:
        The image without its alpha, and the opacity: the mask, otherwise alpha, otherwise None.

    Raises:
        DataError: the photograph or its mask cannot be read, or the mask has another aspect ratio.
    """
    rgba, alpha = read_image(photograph.path)
    stored = rgba.shape[:2]
    rgba = turned(rgba, photograph.orientation)
    upright = rgba.shape[:2]
    opacity = without_haze(rgba[..., 3]) if alpha else None
    if photograph.mask is not None:
        opacity = read_mask(photograph.mask)
        given = opacity.shape
        if _same_shape(opacity.shape, stored) and not _same_shape(opacity.shape, upright):
            opacity = turned(opacity, photograph.orientation)  # the mask belongs to the pixels as they are stored
        elif stored == upright and photograph.orientation != 1:
            opacity = turned(opacity, photograph.orientation)
        if not _same_shape(opacity.shape, upright):
            raise DataError(
                photograph.mask,
                f"the shape of {photograph.path.name}, {stored[1]} x {stored[0]} pixels",
                f"{given[1]} x {given[0]}",
                "give each photograph a mask of its own shape",
            )
    height, width = scaled_size(upright, max_size)

    def stored_as(layer: np.ndarray) -> np.ndarray:
        scaled = np.array(Image.fromarray(layer).resize((width, height), Image.Resampling.BILINEAR))
        return np.ascontiguousarray(np.rot90(scaled)) if photograph.turned else scaled

    return stored_as(np.ascontiguousarray(rgba[..., :3])), None if opacity is None else stored_as(opacity)


def _same_shape(size: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether two sizes have nearly the same aspect ratio."""
    return 1 / _SCALED_MASK < size[0] * other[1] / (size[1] * other[0]) < _SCALED_MASK


def _with_one_shape(photographs: list[Photograph]) -> list[Photograph]:
    """The photographs, with `turned` set for those that differ in format, landscape or portrait, from most of a camera.

    A camera so has images of one size, which share a calibration.
    """
    across: dict[str, Counter[bool]] = {}
    for one in photographs:
        across.setdefault(one.camera, Counter())[one.size[1] > one.size[0]] += 1
    usual = {camera: counts.most_common(1)[0][0] for camera, counts in across.items()}
    return [
        replace(one, turned=one.size[0] != one.size[1] and (one.size[1] > one.size[0]) != usual[one.camera])
        for one in photographs
    ]


def _reads_heif() -> bool:
    """Whether HEIC can be read; registers the format with Pillow."""
    if find_spec("pillow_heif") is None:
        return False
    import pillow_heif

    pillow_heif.register_heif_opener()
    return True


def _exif(path: Path) -> dict[int, Any]:
    """The EXIF tags of a photograph; none if they are damaged."""
    with Image.open(path) as image:
        if "exif" not in image.info:
            return {}
        try:
            exif = image.getexif()
            return {**exif, **exif.get_ifd(_EXIF)}
        except (TypeError, ValueError, SyntaxError, OSError, KeyError):
            return {}


def _focal(tags: dict[int, Any]) -> float | None:
    """The focal length in units of the longer side, from its 35 mm equivalent or from the size of the sensor."""

    def number(tag: int) -> float:
        try:
            value = float(tags.get(tag, 0))
        except (TypeError, ValueError, ZeroDivisionError):
            return 0.0
        return value if math.isfinite(value) and value > 0 else 0.0

    focal = number(_FOCAL_35) / _FULL_FRAME
    resolution, pixels = number(_PLANE_RESOLUTION), number(_PIXELS_X)
    if not focal and resolution and pixels:
        focal = number(_FOCAL) / (pixels / resolution * _UNITS.get(int(number(_PLANE_UNIT) or 2), 25.4))
    return focal if 0.2 < focal < 20 else None
