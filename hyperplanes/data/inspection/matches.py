"""Do pictures agree with their poses? Matched corners decide, where there are no masks.

A point seen by two cameras lies on the epipolar line that each has of the other; the distance to it in pixels, to first
order, is Sampson's error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.feature import gftt_response
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.epipolar import cross_product_matrix, sampson_epipolar_distance
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, max_pool2d, normalize

from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.images.sizes import scaled_size
from hyperplanes.views import Views

__all__ = ["Matches", "match_pictures", "sampson"]

MAX_IMAGE_SIZE = 256  # pixels along the longer side at which corners are looked for
CORNERS = 300  # a picture
PATCH_RADIUS = 6  # pixels on each side of a corner that are compared
LIKE, LIKELIER = 0.8, 0.8  # least correlation of two corners, and how much nearer to 1 it is than the second best
MAX_PAIR_ANGLE = 25.0  # degrees between the axes of a pair; corners look different beyond
MAX_PAIRS = 10


@dataclass(frozen=True)
class Matches:
    """Corners that look alike in pairs of pictures.

    Attributes:
        pairs: the two views of each match, (match, 2).
        pixels: where it is in both, (match, 2, 2), at integer pixel centres of `cameras`.
        cameras: of all views, at the size at which corners were looked for.
    """

    pairs: Tensor
    pixels: Float[Tensor, "match 2 2"]
    cameras: PinholeCamera

    def __len__(self) -> int:
        return len(self.pairs)

    def errors(self, camera_from_world: Float[Tensor, "view 4 4"]) -> Float[Tensor, " match"]:
        """Sampson's error of each match in pixels under these poses; infinite where cameras stand in one place."""
        matrices = camera.intrinsics(self.cameras).double()
        pose = camera_from_world.double()
        first, second = self.pairs.unbind(1)
        error = sampson(self.pixels, matrices[first], matrices[second], pose[second] @ torch.linalg.inv(pose[first]))
        return torch.where(error.isfinite(), error, torch.inf)


@torch.no_grad()
def match_pictures(views: Views, across: Bool[Tensor, " view"] | None = None) -> Matches:
    """Corners matched between views that look in similar directions.

    Args:
        views: of one scene.
        across: match only pairs of which one view is in this set and the other is not.

    Returns:
        The matches of up to MAX_PAIRS pairs; none where no two views look alike.
    """
    axes = normalize(camera.viewing_directions(views.cameras).double(), dim=-1)
    alike = axes @ axes.T
    alike.fill_diagonal_(-2.0)
    if across is not None:
        alike[across[:, None] == across[None]] = -2.0
    nearest = alike.argmax(1).tolist()
    least = math.cos(math.radians(MAX_PAIR_ANGLE))
    pairs = {(min(a, b), max(a, b)) for a, b in enumerate(nearest) if alike[a, b] > least}
    chosen = sorted(pairs, key=lambda pair: -float(alike[pair]))
    chosen = chosen[:: max(1, len(chosen) // MAX_PAIRS)][:MAX_PAIRS]
    size = scaled_size(views.size, MAX_IMAGE_SIZE)
    cameras = camera.resized(views.cameras, *size)
    corners = {view: _corners(views.images[view], size) for view in sorted({view for pair in chosen for view in pair})}
    found = [_matched(corners[a], corners[b]) for a, b in chosen]
    indices = [torch.tensor([pair]).expand(len(pixels), 2) for pair, pixels in zip(chosen, found, strict=True)]
    empty = torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, 2, 2, dtype=torch.float64)
    return Matches(torch.cat([empty[0], *indices]), torch.cat([empty[1], *found]), cameras)


def sampson(
    pixels: Float[Tensor, "match 2 2"],
    first: Float[Tensor, "match 3 3"],
    second: Float[Tensor, "match 3 3"],
    second_from_first: Float[Tensor, "match 4 4"],
) -> Float[Tensor, " match"]:
    """Sampson's error |y' F x| / sqrt((F x)_1^2 + (F x)_2^2 + (F' y)_1^2 + (F' y)_2^2), in pixels.

    Args:
        pixels: x in the first and y in the second picture.
        first: calibration of the first camera.
        second: calibration of the second camera.
        second_from_first: rigid transform between the cameras.

    Returns:
        How far each pair is from being the image of one point, to first order; not finite where the cameras coincide.
    """
    essential = cross_product_matrix(second_from_first[:, :3, 3]) @ second_from_first[:, :3, :3]
    fundamental = torch.linalg.inv(second).mT @ essential @ torch.linalg.inv(first)
    # eps, which releases before 0.9 add to the square, would hide small errors
    return sampson_epipolar_distance(pixels[:, :1], pixels[:, 1:], fundamental, squared=False, eps=0.0)[:, 0]


def _corners(image: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Pixels (corner, 2) of the strongest corners, and what surrounds them, with mean 0 and length 1."""
    grey = interpolate(image.float().cpu().mean(0)[None, None], size, mode="area")
    height, width = size
    border = PATCH_RADIUS + 1
    if min(size) <= 2 * border:
        return torch.zeros(0, 2), torch.zeros(0, (2 * PATCH_RADIUS + 1) ** 2)
    strength = gftt_response(grey)
    strength = strength * (strength == max_pool2d(strength, 5, 1, 2))
    strength = strength[0, 0, border:-border, border:-border]
    best = strength.flatten().topk(min(CORNERS, strength.numel()))
    index = best.indices[best.values > 1e-6]
    pixels = torch.stack([index % strength.shape[1], index // strength.shape[1]], -1).float() + border
    offset = torch.arange(-PATCH_RADIUS, PATCH_RADIUS + 1.0)
    around = torch.cartesian_prod(offset, offset)
    grid = (pixels[:, None] + around) / torch.tensor([(width - 1) / 2, (height - 1) / 2]) - 1
    patches = grid_sample(grey, grid[None], align_corners=True)[0, 0]
    return pixels, normalize(patches - patches.mean(1, keepdim=True), dim=1)


def _matched(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> Float[Tensor, "match 2 2"]:
    """Pixels of the corners that are each other's most alike, clearly more so than any other."""
    if min(len(first[0]), len(second[0])) < 2:
        return torch.zeros(0, 2, 2, dtype=torch.float64)
    alike = first[1] @ second[1].T
    best, chosen = alike.topk(2, 1)
    mutual = alike.argmax(0)[chosen[:, 0]] == torch.arange(len(alike))
    good = mutual & (best[:, 0] > LIKE) & (1 - best[:, 0] < LIKELIER * (1 - best[:, 1]))
    return torch.stack([first[0][good], second[0][chosen[good, 0]]], 1).double()
