"""From the frames that a file lists to posed pictures of one size: what every reader of photographs shares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from hyperplanes.data.pictures.images import (
    Header,
    Pixels,
    check_downscale,
    image_header,
    image_size,
    opacity_of,
    read_image,
    reduced,
    resized,
    turned,
)
from hyperplanes.data.pictures.posed import Posed, posed
from hyperplanes.data.pictures.undistort import check_lens, undistort
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.errors import listed
from hyperplanes.utilities.files import DataError

__all__ = ["MEGAPIXEL", "Frame", "Listing", "assemble", "centred_matrix", "scaled_matrix"]

MEGAPIXEL = 2**20
"""Pixels above which photographs are scaled down unless the caller says by how much."""

ENOUGH = 2 / 3  # of the frames of a file must be there
ROUNDING = 1.01  # pixels by which a picture scaled to whole pixels may differ from the exact size


@dataclass(frozen=True)
class Frame:
    """One picture that a file lists, with its camera; nothing of it has been read.

    Attributes:
        path: of the picture.
        name: of the picture, relative to the folder that is read, or as the file writes it.
        camera_from_world: (4, 4), OpenCV axes, already checked.
        calibrate: the (3, 3) calibration, integer pixel centres, for a picture of (height, width).
        size: (height, width) of the pictures that the calibration was made for, or None where the file does not say.
        lens: OpenCV's coefficients in the order of `undistort.COEFFICIENTS`; empty where there is none.
        mask: a picture of its opacity, or None.
        depths: nearest and farthest distance of what it shows, or None.
    """

    path: Path
    name: str
    camera_from_world: npt.NDArray[np.float64]
    calibrate: Callable[[tuple[int, int]], npt.NDArray[np.float64]]
    size: tuple[int, int] | None = None
    lens: tuple[float, ...] = ()
    mask: Path | None = None
    depths: tuple[float, float] | None = None


@dataclass(frozen=True)
class Listing:
    """What the files of one scene say of it; no picture has been read, and none lies outside of the reader's `root`.

    Attributes:
        frames: its pictures, in the order that they are read in.
        source: the file that lists them, for messages.
        bounds: of the scene; estimated when None.
        up: as in `Views`.
        notes: as in `Posed`.
    """

    frames: Sequence[Frame]
    source: str | Path
    bounds: Sphere | None = None
    up: str | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Found:
    """A frame whose picture is there.

    Attributes:
        frame: as the file lists it.
        stored: (height, width) of the pixels in the file.
        turn: EXIF's orientation where it has to be applied, else 1.
    """

    frame: Frame
    stored: tuple[int, int]
    turn: int

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.stored
        return (width, height) if self.turn >= 5 else self.stored


def assemble(listing: Listing, downscale: int | None = None, *, complete: bool = False) -> tuple[Posed, list[int]]:
    """Read the pictures of frames and bring them to one size.

    Where at least two thirds of the pictures are there, the others are left out and named. So are frames whose picture
    is listed before, links followed: no method is judged by what it was shown. Pictures of several sizes are scaled to
    the commonest one, and their calibrations with them; those of another aspect ratio, as portraits among landscapes,
    by another factor for each axis, so that their pixels are no longer square. EXIF's orientation is
    applied where the size that the file states asks for it. Distorted pictures are undistorted with the same
    calibration.

    Args:
        listing: what the files say.
        downscale: reduce the pictures by this factor, averaging pixels; None leaves a megapixel at most.
        complete: a missing picture is an error, and nothing is scaled down unless asked for: data of ours.

    Returns:
        The pictures, and which of the frames they are. Pictures that are missing or misfit, or a lens that folds the
        picture, are a DataError.
    """
    frames, source = listing.frames, listing.source
    # the frames that have a picture, and one size for all of them
    kept, notes = _present(frames, source, complete)
    found = [_examine(frames[index], source) for index in kept]
    size = _common_size([one.size for one in found])
    if scaled := [one.frame.name for one in found if one.size != size]:
        notes.append(f"{len(scaled)} pictures of other sizes scaled to {size[1]} x {size[0]} pixels: {listed(scaled)}")
    if turns := [one.frame.name for one in found if one.turn != 1]:
        notes.append(f"{len(turns)} pictures turned as their EXIF orientation says: {listed(turns)}")
    factor = _factor(size, downscale, complete, source)
    if factor > 1:
        why = "" if downscale else "; --downscale 1 keeps every pixel"
        notes.append(f"scaled down by {factor}, to {size[1] // factor} x {size[0] // factor} pixels{why}")
    # each picture at that size, without its lens, and its calibration with it
    pictures, alphas, matrices = [], [], []
    for one in found:
        matrix = scaled_matrix(one.frame.calibrate(one.size), one.size, (size[0] / factor, size[1] / factor))
        picture, alpha = _pixels(one, size, factor)
        if any(one.frame.lens):
            check_lens(matrix, one.frame.lens, picture.shape[:2], f"{source}, frame {one.frame.name}")
            picture = undistort(picture, matrix, one.frame.lens, opaque=not alpha)
        pictures.append(picture)
        alphas.append(alpha)
        matrices.append(matrix)
    if any(alphas) and not all(alphas):
        bare = [one.frame.name for one, alpha in zip(found, alphas, strict=True) if not alpha]
        notes.append(f"{len(bare)} of {len(found)} pictures have no mask and count as covered: {listed(bare)}")
    depths = [one.frame.depths for one in found]
    scene = posed(
        pictures,
        np.stack([one.frame.camera_from_world for one in found]),
        np.stack(matrices),
        has_alpha=any(alphas),
        bounds=listing.bounds,
        names=tuple(one.frame.name for one in found),
        source=source,
        depths=None if None in depths else torch.tensor(depths, dtype=torch.float32),
        notes=tuple(notes),
    )
    return replace(scene, up=listing.up, notes=(*scene.notes, *listing.notes)), kept


def _present(frames: Sequence[Frame], source: str | Path, complete: bool) -> tuple[list[int], list[str]]:
    """Which frames have a picture that no frame before them has, and what to say of the others."""
    there = [index for index, frame in enumerate(frames) if frame.path.exists()]
    missing = [frame for frame in frames if not frame.path.exists()]
    notes = []
    if missing and complete:
        raise DataError(missing[0].path, "an image", "nothing", "generate or copy the data set again")
    if missing and len(there) < ENOUGH * len(frames):
        raise DataError(
            source,
            f"the pictures of its {len(frames)} frames, or of two thirds of them",
            f"{len(there)} ({missing[0].path} and {len(missing) - 1} others are missing)",
            "copy the pictures to where the file names them",
        )
    if missing:
        names = listed([frame.name for frame in missing])
        notes.append(f"{len(there)} of {len(frames)} frames have a picture, {len(missing)} are missing: {names}")
    first: dict[Path, int] = {}
    for index in there:
        first.setdefault(frames[index].path.resolve(), index)
    kept = list(first.values())
    if again := [frames[index].name for index in sorted({*there} - {*kept})]:
        notes.append(f"{len(again)} frames left out, whose pictures are listed before: {listed(again)}")
    return kept, notes


def _examine(frame: Frame, source: str | Path) -> _Found:
    """Whether the picture has to be turned; DataError where it cannot be the one that the calibration is for."""
    header = image_header(frame.path)
    if frame.size is None:
        if header.orientation != 1:
            raise DataError(
                frame.path,
                "pixels stored upright, as the cameras' file does not say for which size it was made",
                f"EXIF orientation {header.orientation}",
                "turn the pixels (mogrify -auto-orient), or drop the tag where the poses are of the stored pixels",
            )
        return _Found(frame, header.size, 1)
    if _same_shape(header.size, frame.size):
        return _Found(frame, header.size, 1)  # COLMAP and nerfstudio take the pixels as they are stored
    if header.orientation >= 5 and _same_shape(header.upright_size, frame.size):
        return _Found(frame, header.size, header.orientation)
    raise DataError(
        frame.path,
        f"the shape of the {frame.size[1]} x {frame.size[0]} pixels that {Path(source).name} states",
        f"{_text(header)}",
        "give the pictures that the cameras were made for, or correct w and h",
    )


def _text(header: Header) -> str:
    turned = f" with EXIF orientation {header.orientation}" if header.orientation != 1 else ""
    return f"{header.size[1]} x {header.size[0]}{turned}"


def _same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one is the other scaled, but for rounding to whole pixels."""
    (height, width), (tall, wide) = size, other
    return abs(width / wide * tall - height) < ROUNDING or abs(height / tall * wide - width) < ROUNDING


def _common_size(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The commonest size of those of the commonest shape."""
    counts = Counter(sizes)
    return max(counts, key=lambda each: (sum(n for s, n in counts.items() if _same_shape(s, each)), counts[each]))


def _factor(size: tuple[int, int], downscale: int | None, complete: bool, source: str | Path) -> int:
    if downscale is None:
        factor = 1
        while not complete and (size[0] // factor) * (size[1] // factor) > MEGAPIXEL:
            factor += 1
        return factor
    check_downscale(downscale, size, source)
    return downscale


def scaled_matrix(
    matrix: npt.NDArray[np.float64], own: tuple[float, float], size: tuple[float, float]
) -> npt.NDArray[np.float64]:
    """The calibration of a picture scaled from one (height, width) to another: its borders stay in place.

    Args:
        matrix: (3, 3), integer pixel centres.
        own: the size that it was made for.
        size: the one that is wanted, which need not be whole.
    """
    scale = np.array([size[1] / own[1], size[0] / own[0]])
    result = matrix.copy()
    result[:2, :2] *= scale[:, None]
    result[:2, 2] = scale * (matrix[:2, 2] + 0.5) - 0.5
    return result


def centred_matrix(focal: float, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """The calibration, integer pixel centres, of a picture of (height, width) around its middle; `focal` is in widths.

    >>> centred_matrix(0.5, (2, 4)).tolist()
    [[2.0, 0.0, 1.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]
    """
    height, width = size
    return np.array([[focal * width, 0.0, (width - 1) / 2], [0.0, focal * width, (height - 1) / 2], [0.0, 0.0, 1.0]])


def _pixels(one: _Found, size: tuple[int, int], factor: int) -> tuple[Pixels, bool]:
    picture, alpha = read_image(one.frame.path, one.stored)
    picture = turned(picture, one.turn)
    if one.frame.mask is not None and not (alpha and (picture[..., 3] < 255).any()):
        stored = image_size(one.frame.mask)
        if stored not in (one.size, one.stored):
            raise DataError(
                one.frame.mask,
                f"{one.size[1]} x {one.size[0]} pixels, as {one.frame.path.name}",
                f"{stored[1]} x {stored[0]}",
                "scale the mask to the size of its picture",
            )
        values, has_alpha = read_image(one.frame.mask, stored)
        picture[..., 3] = opacity_of(values if stored == one.size else turned(values, one.turn), has_alpha)
        alpha = True
    return reduced(resized(picture, size), factor), alpha
