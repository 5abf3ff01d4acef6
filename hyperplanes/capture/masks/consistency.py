"""Check the masks of one object against each other: each is compared with the visual hull of all others."""

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
from hyperplanes.utilities.images.sizes import scaled_size

__all__ = ["Agreement", "agree"]

COARSE_SIDE, FINE_SIDE = 80, 120  # voxels per axis: of the first hull, and of the one that masks are compared with
MAX_MASK_SIZE = 240  # pixels along the longer side of the masks that are compared
MIN_MASKS = 8  # views; with fewer, masks are not compared
MIN_VIEW_SHARE = 0.25  # of the views: the least share that must show a voxel within their borders
MOST_VOTES = 0.125  # of the views
SETTLED = 0.01  # least gain in intersection over union for which more votes are taken
ZOOM = 1.15  # radii of the first hull: the sphere in which it is carved again
DEEP = 0.05  # of the square root of the object's area: the radius of the disc that a difference must contain
NEIGHBOUR = np.deg2rad(30)  # a mask is filled only if cameras within this angle look from opposite sides of its camera
FRINGE = 2  # reduced pixels around a removed part: its soft edge, whose opacity is too low to belong to the part
DISAGREES = 0.05  # of the object's area: masks with larger differences contradict the others

Mask = Float[np.ndarray, "height width"]


@dataclass(frozen=True)
class Agreement:
    """Masks after the comparison.

    Attributes:
        masks: one per camera. Parts that contradict the other masks are filled or removed.
        disagreement: for each camera, the area of these parts relative to the area of the object.
        votes: number of masks that had to rule a voxel out.
        hull: the visual hull of all masks, None if it is empty.
    """

    masks: list[Mask]
    disagreement: Float[np.ndarray, " camera"]
    votes: int
    hull: Occupancy | None

    @property
    def sphere(self) -> Sphere | None:
        """The sphere around the hull, None without a hull."""
        return None if self.hull is None else _ball(self.hull)

    @property
    def wrong(self) -> list[int]:
        """The indices of cameras whose masks contradict the others."""
        return np.flatnonzero(self.disagreement > DISAGREES).tolist()


def agree(
    masks: Sequence[Mask],
    model: SparseModel,
    sphere: Sphere,
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]] | None = None,
) -> Agreement:
    """Compare each mask with the silhouette of the visual hull of all others, and correct what contradicts it.

    A voxel belongs to the hull if fewer than `votes` masks rule it out and at least a quarter of the images show it
    within their borders. `votes` is the number for which the silhouettes of the hull agree best with the masks, by the
    median intersection over union of the views. It is 1 if the masks agree, and at most one per eight views.

    The hull of the others is larger than the object by the voxels that only this view rules out. With many views these
    form a thin layer, so only differences into which a disc fits count. A mask is filled only if cameras near its own
    look from opposite sides of it, so that the hull is tight there.

    If masks contradict each other, thin parts that they lack are found by colour: pixels in the silhouette of the hull
    of the others that resemble the rest of the object in the image are added. This favours masks that are too large,
    because a part that is missing in one mask is missing in the visual hull of all.

    Args:
        masks: one per camera, opacity of the undistorted image.
        model: its cameras.
        sphere: that contains the object.
        pictures: the undistorted images. Without them nothing is added by colour.

    Returns:
        The corrected masks and the hull. Fewer than eight masks are returned as they are.
    """
    small = [_reduced(mask) for mask in masks]
    pairs = [(each, _camera(model, row, masks[row], each.shape)) for row, each in enumerate(small)]
    grid = _voxel_votes(pairs, sphere, COARSE_SIDE)
    votes = _votes(grid, pairs)
    hull = grid.hull(votes)
    ball = _ball(hull)
    if ball is not None:  # the same again, finer
        grid = _voxel_votes(pairs, Sphere(ball.centre, min(ZOOM * ball.radius, sphere.radius)), FINE_SIDE)
        votes = _votes(grid, pairs)
        hull = grid.hull(votes)
    if not hull.occupied.any():
        return Agreement(list(masks), np.zeros(len(masks)), votes, None)
    if len(masks) < MIN_MASKS:
        return Agreement(list(masks), np.zeros(len(masks)), votes, hull)
    surrounded = _is_surrounded(model, hull.bounds)
    mended, disagreement, outlines = [], [], []
    for row, (reduced, one) in enumerate(pairs):
        others = grid.hull(votes, without=row)
        seen = silhouettes(others.centres(), others, one)[0].numpy()
        lost, extra = _differences(reduced, seen)
        lost &= surrounded[row]
        rest = seen | (reduced & ~extra)
        fringe = ndimage.binary_dilation(extra, np.ones((3, 3)), FRINGE, mask=~rest)
        mended.append(_mended(masks[row], lost, extra | fringe))
        disagreement.append((lost.sum() + extra.sum()) / max(1, seen.sum()))
        outlines.append(seen)
    found = Agreement(mended, np.array(disagreement), votes, hull)
    if pictures is None or not found.wrong:
        return found
    return replace(found, masks=[extended(*each) for each in zip(pictures, mended, outlines, strict=True)])


def _reduced(mask: Mask) -> Bool[np.ndarray, "row column"]:
    """A mask reduced to at most MAX_MASK_SIZE pixels along its longer side."""
    picture = Image.fromarray(mask.astype(np.float32))
    return np.asarray(picture.resize(scaled_size(picture.size, MAX_MASK_SIZE), Image.Resampling.BOX)) > 0.4


def _camera(model: SparseModel, row: int, mask: Mask, size: tuple[int, ...]) -> PinholeCamera:
    """The camera of a mask that was reduced to (height, width)."""
    calibration = torch.from_numpy(model.calibrations[row : row + 1]).float()
    pose = torch.from_numpy(model.camera_from_world[row : row + 1]).float()
    return camera.resized(camera.pinhole(calibration, pose, *mask.shape), size[0], size[1])


@dataclass(frozen=True)
class _VoxelVotes:
    """For the voxels of a grid, whether each mask rules them out, and whether enough images show them."""

    ruled: Bool[Tensor, "camera x y z"]
    candidate: Bool[Tensor, "x y z"]
    sphere: Sphere

    def hull(self, votes: int, without: int | None = None) -> Occupancy:
        """The visual hull: voxels that fewer than `votes` masks rule out; without the mask of one camera if given."""
        counts = self.counts if without is None else self.counts - self.ruled[without].int()
        return Occupancy(self.candidate & (counts < votes), self.sphere)

    @cached_property
    def counts(self) -> Int[Tensor, "x y z"]:
        """How many masks rule each voxel out."""
        return self.ruled.sum(0, dtype=torch.int32)


def _voxel_votes(pairs: Sequence[tuple[np.ndarray, PinholeCamera]], sphere: Sphere, side: int) -> _VoxelVotes:
    """The votes of all masks on the voxels of a grid with `side` voxels per axis."""
    ruled = torch.stack([_ruled_out(mask, one, sphere, side) for mask, one in pairs])
    # an image shows those voxels within its borders that an empty mask would rule out; half the resolution suffices
    shown = sum((_ruled_out(np.zeros_like(mask), one, sphere, side // 2).int() for mask, one in pairs), torch.zeros(()))
    candidate = shown >= max(2.0, MIN_VIEW_SHARE * len(pairs))
    for axis in range(3):
        candidate = candidate.repeat_interleave(2, axis)
    return _VoxelVotes(ruled, candidate, sphere)


def _ruled_out(mask: np.ndarray, one: PinholeCamera, sphere: Sphere, side: int) -> Bool[Tensor, "x y z"]:
    """The voxels that one mask rules out."""
    return ~carve(torch.from_numpy(mask)[None, None], one, sphere, side).occupied


def _votes(grid: _VoxelVotes, pairs: Sequence[tuple[np.ndarray, PinholeCamera]]) -> int:
    """The least number of votes for which the agreement of hull and masks is within SETTLED of the best."""
    most = max(1, int(MOST_VOTES * len(pairs)))
    chosen = [pair for pair in pairs[:: max(1, len(pairs) // 16)] if pair[0].any()]
    if most == 1 or not chosen:
        return 1
    agreement = []
    for votes in range(1, most + 1):
        hull = grid.hull(votes)
        points = hull.centres()
        found = [(silhouettes(points, hull, one)[0].numpy(), mask) for mask, one in chosen]
        agreement.append(float(np.median([(seen & mask).sum() / (seen | mask).sum() for seen, mask in found])))
    return 1 + next(index for index, value in enumerate(agreement) if value >= max(agreement) - SETTLED)


def _ball(hull: Occupancy) -> Sphere | None:
    """The sphere around the voxels of a hull that lie within its bounds, None if there are none."""
    points = hull.surface_centres
    points = points[hull.bounds.normalise(points).norm(dim=-1) <= 1]
    if not len(points):
        return None
    ball = smallest_ball(points, hull.voxel)
    return Sphere(ball.centre, min(ball.radius, hull.bounds.radius))


def _differences(mask: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts of a silhouette that a mask lacks, and those of the mask outside it, where a disc fits into them."""
    radius = max(2, round(DEEP * float(np.sqrt(seen.sum()))))
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    disc = rows**2 + columns**2 <= radius**2

    def deep(difference: np.ndarray) -> np.ndarray:
        padded = np.pad(difference, radius, mode="edge")  # so that the image border does not limit a difference
        opened = np.asarray(ndimage.binary_opening(padded, disc))[radius:-radius, radius:-radius]
        return ndimage.binary_dilation(opened, iterations=radius) & difference

    return deep(seen & ~mask), deep(mask & ~np.asarray(ndimage.binary_dilation(seen, iterations=2), dtype=bool))


def _mended(mask: Mask, lost: np.ndarray, extra: np.ndarray) -> Mask:
    """A mask with the lost parts filled and the extra parts removed."""
    if not (lost.any() or extra.any()):
        return mask

    def scaled(part: np.ndarray) -> np.ndarray:
        grown = Image.fromarray(part.astype(np.float32)).resize(mask.shape[::-1], Image.Resampling.BILINEAR)
        return np.asarray(grown, np.float64)

    return np.maximum(mask * (1 - scaled(extra)), scaled(lost))


def _is_surrounded(model: SparseModel, sphere: Sphere) -> Bool[np.ndarray, " camera"]:
    """Which cameras have others near them on opposite sides; those at the ends of an arc of cameras do not."""
    ways = model.centres - np.array(sphere.centre)
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    result = np.zeros(len(ways), bool)
    for row, way in enumerate(ways):
        cosine = ways @ way
        near = (cosine > np.cos(NEIGHBOUR)) & (cosine < 1 - 1e-6)
        across = ways[near] - cosine[near, None] * way
        result[row] = bool((across @ across.T < 0).any())
    return result
