"""Estimates of the sphere around a scene, for files that do not state one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.occupancy import carve
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError

__all__ = [
    "OFTEN_CUT",
    "ONE_PLACE",
    "SEARCH_RADII",
    "are_shown",
    "cut_off",
    "empty_masks",
    "estimate_bounds",
    "inverted",
    "nearest_point",
    "smallest_ball",
    "stated_bounds",
]

HULL_SIDE = 48
HULL_MARGIN = 1.05
FEWEST_MASKS = 3
MOST_MASKS = 24  # views used: the hull of fewer views is only larger
LARGEST_MASK = 256
MIN_BORDER_COVERAGE = 0.9  # of the pixels at the image border, which an inverted mask covers at least
MIN_OBJECT_COVERAGE = 0.01  # least share of an image that an object covers, for its mask to be recognised as inverted
OFTEN_CUT = 0.1  # of the masks: a larger share at the border of their image counts as a scene of close-ups
SEARCH_RADII = 3.0  # radii of the sphere from the cameras: where the hull of such a scene is searched
SMALLEST_DISTANCE = 1e-6  # of a camera from the centre, in units of the largest distance of one from their mean
ONE_PLACE = 2.0**-21  # of the distance from the origin: float32 rounding moves cameras at one position this far apart
# of the images that show the object whole, or of all images, that must show a point
MIN_WHOLE_SHARE, MIN_SHOWN_SHARE = 0.9, 0.25


def estimate_bounds(
    cameras: PinholeCamera,
    alpha: UInt8[Tensor, "view 1 height width"] | None = None,
    depths: Float[Tensor, "view 2"] | None = None,
) -> Sphere:
    """A sphere that contains what the cameras look at.

    From the cameras alone, the centre is the point nearest to all optical axes. The radius is that of the largest
    sphere that a camera at distance d sees whole, r = d sin(half the smaller field of view): the median over the
    cameras, and at most 95 % of the distance of the nearest camera. If the known depths show that a quarter of the
    cameras or more do not look at this centre, as in forward-facing scenes, the centre is the median of the points
    ahead of the cameras in the middle of their depths.

    With masks of three views or more, the visual hull is carved inside that sphere, and again inside the sphere around
    the first hull. The result is the sphere around its voxels, 5 % larger, and at most as large as the one from the
    cameras.

    A mask that is cut off by the border of its image is no outline there. If more than a tenth of the masks are, as in
    close-ups, the object may be larger than the sphere from the cameras. The hull is then carved in a sphere three
    times as large, and only its points that `are_shown` accepts count.

    Empty masks are not used: one that is empty by mistake would remove the whole object from the hull. Masks of cameras
    with lens distortion are not used either; the result is then the sphere from the cameras.

    Args:
        cameras: of one scene.
        alpha: their masks, or None if the images have none.
        depths: nearest and farthest distance of what each camera shows, or None.
    """
    outer = _from_cameras(cameras, depths)
    if alpha is None or isinstance(cameras, DistortedCamera) or len(alpha) < FEWEST_MASKS or not alpha.any():
        return outer
    if (empty := empty_masks(alpha)).any():
        alpha, cameras = alpha[~empty], camera.select(cameras, ~empty)
        if len(alpha) < FEWEST_MASKS:
            return outer
    chosen = torch.linspace(0, len(alpha) - 1, min(len(alpha), MOST_MASKS)).round().long()
    masks, small = _reduced(alpha[chosen], camera.select(cameras, chosen))
    ends = cut_off(masks)
    cut = float(ends.float().mean()) > OFTEN_CUT
    sphere = largest = Sphere(outer.centre, SEARCH_RADII * outer.radius) if cut else outer
    for _ in range(3 if cut else 2):
        points = carve(masks, small, sphere, HULL_SIDE).centres()
        points = points[sphere.normalise(points).norm(dim=-1) <= 1]
        points = points[are_shown(points, small, ends)] if cut else points
        if not len(points):
            return outer if sphere is largest else sphere
        ball = smallest_ball(points, sphere.radius / HULL_SIDE * 3**0.5)
        sphere = Sphere(ball.centre, min(HULL_MARGIN * ball.radius, largest.radius))
    return sphere


def cut_off(
    masks: Float[Tensor, "view 1 height width"] | UInt8[Tensor, "view 1 height width"],
) -> Bool[Tensor, " view"]:
    """Which masks reach the border of their image.

    A single pixel that is hardly opaque suffices, because a view that counts as showing the object whole limits the
    sphere. `visibility.penalties.margins`, which is for the blending weights of colours, tolerates a few pixels.
    """
    opaque = masks[:, 0] > 0
    sides = [opaque[:, 0], opaque[:, -1], opaque[:, :, 0], opaque[:, :, -1]]
    return torch.cat(sides, -1).any(-1)


def empty_masks(
    masks: Float[Tensor, "view 1 height width"] | UInt8[Tensor, "view 1 height width"],
) -> Bool[Tensor, " view"]:
    """Which masks show nothing. No hull that other masks show agrees with one whose camera looks at the object."""
    return masks.flatten(1).amax(1) == 0


def inverted(
    masks: Float[Tensor, "view 1 height width"] | UInt8[Tensor, "view 1 height width"],
) -> Bool[Tensor, " view"]:
    """Which masks seem to mark the background: they cover the border of their image, and less of the whole image.

    A close-up of an object also covers the border. A minority of such masks is therefore reported only if most of the
    other masks do not reach the border.
    """
    opaque = masks[:, 0] > (127 if masks.dtype == torch.uint8 else 0.5)
    border = torch.cat([opaque[:, 0], opaque[:, -1], opaque[:, :, 0], opaque[:, :, -1]], -1).float().mean(-1)
    found = (border > MIN_BORDER_COVERAGE) & (opaque.flatten(1).float().mean(-1) < border - MIN_OBJECT_COVERAGE)
    most = 2 * int(found.sum()) > len(masks)
    if most or (found.any() and 2 * int(cut_off(masks[~found]).sum()) < int((~found).sum())):
        return found
    return torch.zeros_like(found)


def are_shown(
    points: Float[Tensor, "point 3"], cameras: PinholeCamera, cut: Bool[Tensor, " view"]
) -> Bool[Tensor, " point"]:
    """Whether each point may belong to the object: 90 % of the images that show the object whole show the point.

    If fewer than three images show the object whole, a quarter of all images must show the point. In both cases at
    least two images must.

    Args:
        points: in the world.
        cameras: of one image size.
        cut: which images do not show the object whole.
    """
    height, width = camera.image_size(cameras)
    matrices = camera.projection_matrices(cameras)
    whole = int((~cut).sum()) >= FEWEST_MASKS
    matrices = matrices[~cut] if whole else matrices
    count = torch.zeros(len(points), dtype=torch.long)
    for matrix in matrices:
        seen = points @ matrix[:, :3].T + matrix[:, 3]
        front = seen[:, 2] > 0
        column, row = (seen[:, :2] / torch.where(front, seen[:, 2], 1.0)[:, None]).unbind(-1)
        count += front & (column > 0) & (row > 0) & (column < width - 1) & (row < height - 1)
    return count >= max(2.0, (MIN_WHOLE_SHARE if whole else MIN_SHOWN_SHARE) * len(matrices))


def stated_bounds(document: dict[str, Any], path: Path) -> Sphere | None:
    """The field "scene_sphere" of a transforms.json or a manifest, or None if there is none.

    Returns:
        The sphere in the world of the poses.

    Raises:
        DataError: no centre and radius, numbers that are not finite, or a radius that is not positive.
    """
    stated = document.get("scene_sphere")
    if stated is None:
        return None
    try:
        x, y, z = (float(value) for value in stated["centre"])
        radius = float(stated["radius"])
    except (TypeError, KeyError, ValueError) as error:
        raise DataError(path, "scene_sphere with centre and radius", repr(stated), "correct the file") from error
    if not all(map(math.isfinite, (x, y, z, radius))) or radius <= 0:
        raise DataError(path, "a scene_sphere of finite numbers, radius > 0", repr(stated), "correct the file")
    return Sphere((x, y, z), radius)


def nearest_point(centres: Float[Tensor, "view 3"], directions: Float[Tensor, "view 3"]) -> Float[Tensor, " 3"]:
    """The point with the least sum of squared distances to lines; for parallel lines, that nearest to their centres.

    >>> eyes = torch.tensor([[0.0, 0.0, 3.0], [2.0, 0.0, 0.0]])
    >>> nearest_point(eyes, torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])).round().abs().tolist()
    [0.0, 0.0, 0.0]
    """
    across = torch.eye(3, dtype=torch.float64) - directions.double()[:, :, None] * directions.double()[:, None, :]
    middle = centres.double().mean(0)
    right = (across @ (centres.double() - middle)[:, :, None]).sum(0)
    return (middle + (torch.linalg.pinv(across.sum(0), rtol=1e-6, hermitian=True) @ right).squeeze(-1)).to(centres)


def _from_cameras(cameras: PinholeCamera, depths: Tensor | None) -> Sphere:
    eyes, axes = camera.centres(cameras), camera.viewing_directions(cameras)
    centre = nearest_point(eyes, axes)
    if depths is not None and _look_past_it(centre, eyes, axes, depths):
        tiny = torch.finfo(eyes.dtype).tiny
        middle = 2 / (1 / depths.to(eyes).clamp_min(tiny)).sum(1, keepdim=True)  # the mean in disparity
        centre = (eyes + axes * middle).median(0).values
    distance = (eyes - centre).norm(dim=-1)
    height, width = camera.image_size(cameras)
    focal = camera.intrinsics(cameras)[:, [0, 1], [0, 1]]
    half = torch.atan(focal.new_tensor([width / 2, height / 2]) / focal).amin(-1)
    radius = float((distance * half.sin()).median())
    nearest = float(distance.min())
    # all cameras in one position, up to the rounding of float32: the point a unit ahead of them
    spread = float((eyes - eyes.mean(0)).norm(dim=-1).max())
    least = max(SMALLEST_DISTANCE * spread, ONE_PLACE * float(eyes.norm(dim=-1).max()))
    if min(nearest, radius) <= least:
        return Sphere(tuple((eyes + axes).mean(0).tolist()), 1.0)
    return Sphere(tuple(centre.tolist()), min(radius, 0.95 * nearest))


def _look_past_it(centre: Tensor, eyes: Tensor, axes: Tensor, depths: Tensor) -> bool:
    """Whether the centre is outside the depths that a camera shows, for at least a quarter of the cameras."""
    ahead = ((centre - eyes) * axes).sum(-1)
    low, high = depths.to(eyes).unbind(1)
    return float(((ahead < low) | (ahead > high)).float().mean()) >= 0.25


def smallest_ball(points: Float[Tensor, "point 3"], margin: float = 0.0) -> Sphere:
    """Nearly the smallest sphere around points (Badoiu and Clarkson, 2003: 100 steps are within a few percent).

    Args:
        points: one or more. Grid points that are ordered along z take a third of the time.
        margin: added to the radius, in world units, as for voxels around the points; above 0 if the points may all be
            in one place.
    """
    # a point between two others on a line along z is never the farthest
    step = points.diff(dim=0)
    along, up, down = (step[:, :2] == 0).all(1), step[:, 2] > 0, step[:, 2] < 0
    between = along[1:] & along[:-1] & (up[1:] & up[:-1] | down[1:] & down[:-1])
    points = torch.cat([points[:1], points[1:-1][~between], points[1:][-1:]])
    centre = (points.amin(0) + points.amax(0)) / 2
    for step in range(1, 100):
        farthest = points[(points - centre).square().sum(-1).argmax()]
        centre = centre + (farthest - centre) / (step + 1)
    return Sphere(tuple(centre.tolist()), float((points - centre).norm(dim=-1).max()) + margin)


def _reduced(alpha: Tensor, cameras: PinholeCamera) -> tuple[Tensor, PinholeCamera]:
    """Masks reduced by max pooling so that carving is fast, and their cameras."""
    height, width = alpha.shape[2:]
    factor = -(-max(height, width) // LARGEST_MASK)
    if factor == 1:
        return alpha.float(), cameras
    size = -(-height // factor), -(-width // factor)
    padded = torch.nn.functional.pad(alpha, (0, size[1] * factor - width, 0, size[0] * factor - height))
    masks = torch.nn.functional.max_pool2d(padded.float(), factor)
    return masks, camera.resized(camera.cropped(cameras, size[0] * factor, size[1] * factor), *size)
