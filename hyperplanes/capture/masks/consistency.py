"""Masks of one object seen from many sides must agree: each is judged by the visual hull of all others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from kornia.geometry.camera import PinholeCamera
from PIL import Image
from scipy import ndimage
from torch import Tensor

from hyperplanes.capture.masks.grabcut import extended
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.data.inspection.silhouettes import silhouettes
from hyperplanes.data.pictures.bounds import smallest_ball
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Sphere

__all__ = ["Agreement", "agree"]

COARSE, FINE = 80, 120  # voxels an axis, of the hull that is searched and of the one that masks are compared with
LONGEST = 240  # pixels of the masks that are compared
FEWEST = 8  # views, below which masks are not judged
SEEN = 0.25  # of the views must show a place within their borders for it to belong to the object
MOST_VOTES = 0.125  # of the views
SETTLED = 0.01  # of intersection over union, by which more votes must be better
ZOOM = 1.15  # times the radius of the hull: where it is judged again
DEEP = 0.05  # of the square root of an area: differences thinner than that are the hull's own
NEIGHBOUR = np.deg2rad(30)  # within which others must look, from opposite sides, for a mask to be filled
DISAGREES = 0.05  # of the object's area

Mask = Float[np.ndarray, "height width"]


@dataclass(frozen=True)
class Agreement:
    """Masks after they were compared.

    Attributes:
        masks: one a camera; parts that contradict the others are filled or taken away.
        disagreement: for each camera, the area that was wrong, of that of the object.
        votes: how many masks had to rule a place out.
        hull: what they show together, None where they show nothing.
    """

    masks: list[Mask]
    disagreement: Float[np.ndarray, " camera"]
    votes: int
    hull: Occupancy | None

    @property
    def sphere(self) -> Sphere | None:
        """The sphere around the hull, None where there is none."""
        return None if self.hull is None else _ball(self.hull)

    @property
    def wrong(self) -> list[int]:
        """The cameras whose mask contradicted the others."""
        return np.flatnonzero(self.disagreement > DISAGREES).tolist()


def agree(
    masks: Sequence[Mask],
    model: SparseModel,
    sphere: Sphere,
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]] | None = None,
) -> Agreement:
    """Compare each mask with the silhouette of the hull of all others, and mend what they contradict.

    A place belongs to the hull where fewer than `votes` masks rule it out, and where a quarter of the pictures show it
    within their borders. The number of votes is the one with which the silhouettes of the hull agree best with the
    masks (median over the views of intersection over union): one with masks that agree, at most one for every eight
    views.

    The hull of the others is larger than the object by what only this view sees past, a thin seam where views are
    many. So only differences that a disc fits into count, and a mask is filled only where other cameras look from
    nearly the same side, to the left and to the right of it.

    Where masks contradict each other, what they lack in thin parts is found by colour: within the hull of the others,
    what resembles the rest of the object in its picture is added. Pieces that are missing cost more than ones too many,
    since a field is carved out of all masks.

    Args:
        masks: one a camera, opacity of the picture without its lens.
        model: its cameras.
        sphere: that holds the object.
        pictures: what the masks are of, without which nothing is found by colour.
    """
    small = [_reduced(mask) for mask in masks]
    pairs = [(each, _camera(model, row, masks[row], each.shape)) for row, each in enumerate(small)]
    judged = _judged(pairs, sphere, COARSE)
    votes = _votes(judged, pairs)
    hull = judged.hull(votes)
    ball = _ball(hull)
    if ball is not None:  # the same again, finer
        judged = _judged(pairs, Sphere(ball.centre, min(ZOOM * ball.radius, sphere.radius)), FINE)
        votes = _votes(judged, pairs)
        hull = judged.hull(votes)
    if not hull.occupied.any():
        return Agreement(list(masks), np.zeros(len(masks)), votes, None)
    if len(masks) < FEWEST:
        return Agreement(list(masks), np.zeros(len(masks)), votes, hull)
    surrounded = _is_surrounded(model, hull.bounds)
    mended, disagreement, outlines = [], [], []
    for row, (reduced, one) in enumerate(pairs):
        others = judged.hull(votes, without=row)
        seen = silhouettes(others.centres(), others, one)[0].numpy()
        lost, extra = _differences(reduced, seen)
        lost &= surrounded[row]
        mended.append(_mended(masks[row], lost, extra))
        disagreement.append((lost.sum() + extra.sum()) / max(1, seen.sum()))
        outlines.append(seen)
    found = Agreement(mended, np.array(disagreement), votes, hull)
    if pictures is None or not found.wrong:
        return found
    return replace(found, masks=[extended(*each) for each in zip(pictures, mended, outlines, strict=True)])


def _reduced(mask: Mask) -> Bool[np.ndarray, "row column"]:
    height, width = mask.shape
    factor = min(1.0, LONGEST / max(height, width))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(Image.fromarray(mask.astype(np.float32)).resize(size, Image.Resampling.BOX)) > 0.4


def _camera(model: SparseModel, row: int, mask: Mask, size: tuple[int, ...]) -> PinholeCamera:
    calibration = torch.from_numpy(model.calibrations[row : row + 1]).float()
    pose = torch.from_numpy(model.camera_from_world[row : row + 1]).float()
    return camera.resized(camera.pinhole(calibration, pose, *mask.shape), size[0], size[1])


@dataclass(frozen=True)
class _Judged:
    """What each mask says of the voxels of a grid: whether it rules them out, and which of them may be the object."""

    ruled: Bool[Tensor, "camera x y z"]
    candidate: Bool[Tensor, "x y z"]
    sphere: Sphere

    def hull(self, votes: int, without: int | None = None) -> Occupancy:
        """The voxels that fewer than `votes` masks rule out, one of them left out where asked."""
        counts = self.counts if without is None else self.counts - self.ruled[without].int()
        return Occupancy(self.candidate & (counts < votes), self.sphere)

    @cached_property
    def counts(self) -> Int[Tensor, "x y z"]:
        """How many masks rule each voxel out."""
        return self.ruled.sum(0, dtype=torch.int32)


def _judged(pairs: Sequence[tuple[np.ndarray, PinholeCamera]], sphere: Sphere, side: int) -> _Judged:
    ruled = torch.stack([_ruled_out(mask, one, sphere, side) for mask, one in pairs])
    # what the pictures show within their borders is an empty mask's to rule out; half as fine will do
    shown = sum((_ruled_out(np.zeros_like(mask), one, sphere, side // 2).int() for mask, one in pairs), torch.zeros(()))
    candidate = shown >= max(2.0, SEEN * len(pairs))
    for axis in range(3):
        candidate = candidate.repeat_interleave(2, axis)
    return _Judged(ruled, candidate, sphere)


def _ruled_out(mask: np.ndarray, one: PinholeCamera, sphere: Sphere, side: int) -> Bool[Tensor, "x y z"]:
    """The voxels that one mask rules out."""
    return ~carve(torch.from_numpy(mask)[None, None], one, sphere, side).occupied


def _votes(judged: _Judged, pairs: Sequence[tuple[np.ndarray, PinholeCamera]]) -> int:
    """The number of votes with which hull and masks agree best; the least of those that are about as good."""
    most = max(1, int(MOST_VOTES * len(pairs)))
    chosen = [pair for pair in pairs[:: max(1, len(pairs) // 16)] if pair[0].any()]
    if most == 1 or not chosen:
        return 1
    agreement = []
    for votes in range(1, most + 1):
        hull = judged.hull(votes)
        points = hull.centres()
        found = [(silhouettes(points, hull, one)[0].numpy(), mask) for mask, one in chosen]
        agreement.append(float(np.median([(seen & mask).sum() / (seen | mask).sum() for seen, mask in found])))
    return 1 + next(index for index, value in enumerate(agreement) if value >= max(agreement) - SETTLED)


def _ball(hull: Occupancy) -> Sphere | None:
    """The sphere around the voxels of a hull that lie within its bounds, None where there are none."""
    points = hull.surface_centres
    points = points[hull.bounds.normalise(points).norm(dim=-1) <= 1]
    if not len(points):
        return None
    ball = smallest_ball(points)
    return Sphere(ball.centre, min(ball.radius + hull.voxel, hull.bounds.radius))


def _differences(mask: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a mask lacks of a silhouette, and what it has beside it, where a disc fits in."""
    radius = max(2, round(DEEP * float(np.sqrt(seen.sum()))))
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    disc = rows**2 + columns**2 <= radius**2

    def deep(difference: np.ndarray) -> np.ndarray:
        padded = np.pad(difference, radius, mode="edge")  # the border of the picture is no border of the difference
        opened = np.asarray(ndimage.binary_opening(padded, disc))[radius:-radius, radius:-radius]
        return ndimage.binary_dilation(opened, iterations=radius) & difference

    return deep(seen & ~mask), deep(mask & ~np.asarray(ndimage.binary_dilation(seen, iterations=2), dtype=bool))


def _mended(mask: Mask, lost: np.ndarray, extra: np.ndarray) -> Mask:
    """A mask with what it lacked filled and what it had beside the object taken away, where there is any."""
    if not (lost.any() or extra.any()):
        return mask

    def scaled(part: np.ndarray) -> np.ndarray:
        grown = Image.fromarray(part.astype(np.float32)).resize(mask.shape[::-1], Image.Resampling.BILINEAR)
        return np.asarray(grown, np.float64)

    return np.maximum(mask * (1 - scaled(extra)), scaled(lost))


def _is_surrounded(model: SparseModel, sphere: Sphere) -> Bool[np.ndarray, " camera"]:
    """Which cameras have others near them on opposite sides: the hull is not bounded by the outermost of an arc."""
    ways = model.centres - np.array(sphere.centre)
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    result = np.zeros(len(ways), bool)
    for row, way in enumerate(ways):
        cosine = ways @ way
        near = (cosine > np.cos(NEIGHBOUR)) & (cosine < 1 - 1e-6)
        across = ways[near] - cosine[near, None] * way
        result[row] = bool((across @ across.T < 0).any())
    return result
