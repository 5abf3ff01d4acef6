"""Read the images of the frames that a file lists, and bring them to one size; shared by the readers of photographs."""

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
    read_image,
    read_mask,
    reduced,
    resized,
    turned,
    without_haze,
)
from hyperplanes.data.pictures.posed import Posed, posed
from hyperplanes.data.pictures.undistort import check_lens, undistort
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.utilities.messages.formatting import counted

__all__ = ["MEGAPIXEL", "Frame", "Listing", "assemble", "centred_matrix", "scaled_matrix"]

MEGAPIXEL = 2**20
"""Photographs with more pixels are scaled down unless the caller gives a factor."""

MIN_IMAGE_SHARE = 2 / 3  # of the frames of a file: the least share with an image
ROUNDING = 1.01  # pixels: largest difference between the size of a scaled image, in whole pixels, and the exact size


@dataclass(frozen=True)
class Frame:
    """One image that a file lists, with its camera. The image has not been read.

    Attributes:
        path: of the image.
        name: of the image, relative to the folder that is read, or as the file writes it.
        camera_from_world: (4, 4), OpenCV axes, already checked.
        calibrate: returns the (3, 3) calibration, integer pixel centres, for an image of (height, width).
        size: (height, width) of the images that the camera was calibrated for, or None if the file does not state it.
        lens: OpenCV's distortion coefficients in the order of `undistort.COEFFICIENTS`; empty without distortion.
        mask: an image of its opacity, or None.
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
    """What the files of one scene state. No image has been read, and none lies outside the reader's `root`.

    Attributes:
        frames: the images, in the order in which they are read.
        source: the file that lists them, for messages.
        bounds: of the scene; if None, they are estimated.
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
    """A frame whose image exists.

    Attributes:
        frame: as the file lists it.
        stored: (height, width) of the pixels in the file.
        turn: EXIF's orientation if it has to be applied, otherwise 1.
    """

    frame: Frame
    stored: tuple[int, int]
    turn: int

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.stored
        return (width, height) if self.turn >= 5 else self.stored


def assemble(listing: Listing, downscale: int | None = None, *, complete: bool = False) -> tuple[Posed, list[int]]:
    """Read the images of frames and bring them to one size.

    If at most a third of the images are missing, their frames are left out and named in the notes. So are frames whose
    image an earlier frame lists, symbolic links followed, so that no image is both a support and a query view. Images
    of several sizes are scaled to the most common one, and their calibrations with them. Those of another aspect ratio,
    such as portraits among landscapes, are scaled by another factor on each axis, so that their pixels are no longer
    square. EXIF's orientation is applied if the size that the file states requires it. Distorted images are undistorted
    with the same calibration.

    Args:
        listing: what the files state.
        downscale: reduce the images by this factor, averaging pixels. None reduces them to at most MEGAPIXEL pixels.
        complete: treat a missing image as an error, and do not reduce images if `downscale` is None. Readers of native
            data sets and of learnit's layout use it.

    Returns:
        The images, and the indices of the frames that they belong to. Raises DataError if an image is missing or does
        not fit its camera, or if a lens folds an image.
    """
    frames, source = listing.frames, listing.source
    # the frames that have an image, and one size for all of them
    kept, notes = _present(frames, source, complete)
    found = [_examine(frames[index], source) for index in kept]
    size = _common_size([one.size for one in found])
    if scaled := [one.frame.name for one in found if one.size != size]:
        notes.append(
            f"{counted(len(scaled), 'image')} of another size, scaled to {size[1]} x {size[0]} pixels: {listed(scaled)}"
        )
    if turns := [one.frame.name for one in found if one.turn != 1]:
        notes.append(f"{counted(len(turns), 'image')} rotated by their EXIF orientation: {listed(turns)}")
    factor = _factor(size, downscale, complete, source)
    if factor > 1:
        why = "" if downscale else "; --downscale 1 keeps every pixel"
        notes.append(f"scaled down by {factor}, to {size[1] // factor} x {size[0] // factor} pixels{why}")
    # each image scaled to that size and undistorted, with its calibration
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
        notes.append(f"{len(bare)} of {len(found)} images have no mask and are taken as opaque: {listed(bare)}")
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
    """The indices of frames whose image exists and belongs to no earlier frame, and notes about the others."""
    there = [index for index, frame in enumerate(frames) if frame.path.exists()]
    missing = [frame for frame in frames if not frame.path.exists()]
    notes = []
    if missing and complete:
        raise DataError(missing[0].path, "an image", "nothing", "generate or copy the data set again")
    if missing and len(there) < MIN_IMAGE_SHARE * len(frames):
        raise DataError(
            source,
            f"images for at least two thirds of its {len(frames)} frames",
            f"{len(there)} ({missing[0].path} and {len(missing) - 1} others are missing)",
            "copy the images to the paths that the file states",
        )
    if missing:
        names = listed([frame.name for frame in missing])
        notes.append(f"{len(there)} of {len(frames)} frames have an image; missing: {names}")
    first: dict[Path, int] = {}
    for index in there:
        first.setdefault(frames[index].path.resolve(), index)
    kept = list(first.values())
    if again := [frames[index].name for index in sorted({*there} - {*kept})]:
        notes.append(f"{counted(len(again), 'frame')} left out, whose images earlier frames list: {listed(again)}")
    return kept, notes


def _examine(frame: Frame, source: str | Path) -> _Found:
    """The frame and the rotation that its image needs; DataError if the camera was not calibrated for this image."""
    header = image_header(frame.path)
    if frame.size is None:
        if header.orientation != 1:
            raise DataError(
                frame.path,
                "pixels stored upright, as the file of cameras states no image size",
                f"EXIF orientation {header.orientation}",
                "rotate the pixels (mogrify -auto-orient), or remove the tag if the poses are of the stored pixels",
            )
        return _Found(frame, header.size, 1)
    if _same_shape(header.size, frame.size):
        return _Found(frame, header.size, 1)  # COLMAP and nerfstudio ignore EXIF's orientation
    if header.orientation >= 5 and _same_shape(header.upright_size, frame.size):
        return _Found(frame, header.size, header.orientation)
    raise DataError(
        frame.path,
        f"the aspect ratio of the {frame.size[1]} x {frame.size[0]} pixels that {Path(source).name} states",
        f"{_text(header)}",
        "give the images that the cameras were calibrated for, or correct w and h",
    )


def _text(header: Header) -> str:
    turned = f" with EXIF orientation {header.orientation}" if header.orientation != 1 else ""
    return f"{header.size[1]} x {header.size[0]}{turned}"


def _same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size is the other one scaled and rounded to whole pixels."""
    (height, width), (tall, wide) = size, other
    return abs(width / wide * tall - height) < ROUNDING or abs(height / tall * wide - width) < ROUNDING


def _common_size(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The most common size among those of the most common aspect ratio."""
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
    """The calibration of an image that is scaled from one (height, width) to another, with its borders in place.

    Args:
        matrix: (3, 3), integer pixel centres.
        own: the size that the calibration is for.
        size: the new size, which need not be in whole pixels.
    """
    scale = np.array([size[1] / own[1], size[0] / own[0]])
    result = matrix.copy()
    result[:2, :2] *= scale[:, None]
    result[:2, 2] = scale * (matrix[:2, 2] + 0.5) - 0.5
    return result


def centred_matrix(focal: float, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """The calibration, integer pixel centres, of an image of (height, width) with the principal point in its middle.

    `focal` is the focal length in units of the image width.

    >>> centred_matrix(0.5, (2, 4)).tolist()
    [[2.0, 0.0, 1.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]
    """
    height, width = size
    return np.array([[focal * width, 0.0, (width - 1) / 2], [0.0, focal * width, (height - 1) / 2], [0.0, 0.0, 1.0]])


def _pixels(one: _Found, size: tuple[int, int], factor: int) -> tuple[Pixels, bool]:
    """The image of a frame, scaled to a size and then reduced by a factor, and whether its alpha is a mask."""
    picture, alpha = read_image(one.frame.path, one.stored)
    picture = turned(picture, one.turn)
    if one.frame.mask is not None and not (alpha and (picture[..., 3] < 255).any()):
        stored = image_size(one.frame.mask)
        if stored not in (one.size, one.stored):
            raise DataError(
                one.frame.mask,
                f"{one.size[1]} x {one.size[0]} pixels, as {one.frame.path.name}",
                f"{stored[1]} x {stored[0]}",
                "scale the mask to the size of its image",
            )
        opacity = read_mask(one.frame.mask, stored)
        picture[..., 3] = opacity if stored == one.size else turned(opacity, one.turn)
        alpha = True
    elif alpha:
        picture[..., 3] = without_haze(picture[..., 3])
    return reduced(resized(picture, size), factor), alpha
