"""A correction network: what is added to each pixel of a picture, computed from reprojected support views."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hyperplanes.adaptation.reprojection import DOUBT, Reprojected

__all__ = ["DEPTH_OFFSETS", "MIN_CORRECTED_OPACITY", "READINGS", "CorrectionNetwork", "covered", "readings"]

DEPTH_OFFSETS = (-0.06, -0.03, 0.0, 0.03, 0.06)
"""Distances of the points of a ray from the surface of the field, in radii, at which support views are compared."""

READINGS = 16  # inputs for a pixel
COLOUR, CANDIDATES, OPACITY = slice(3), slice(3, 12), slice(12, 13)  # of the inputs
MEAN_RESIDUAL = slice(3, 6)  # at the depth of the field, the first candidate
DEVIATIONS = slice(13, 15)  # of the inputs
INITIAL_WEIGHTS = (0.0, 1.0, 0.0)  # of the candidates
WIDTH, BLOCKS = 32, 2  # channels, and residual blocks of two convolutions each
REACH = 2 + 2 * BLOCKS  # pixels between an output and its farthest input
OUTPUT_SCALE = 0.3
WINDOW = 5  # pixels a side, over which the disagreement of support views is averaged
DISAGREEMENT_SCALE = 1e-3  # difference of variances by which one depth is e times as likely as another one
MIN_CORRECTED_OPACITY = 0.01  # from which on a pixel is corrected in part
FULL_CORRECTION_OPACITY = 1 / 3  # and in full


def covered(opacity: Tensor) -> Tensor:
    """The share of a correction that a pixel of some opacity gets."""
    return (opacity / FULL_CORRECTION_OPACITY).clamp(max=1)


def readings(
    image: Float[Tensor, "3 height width"],
    opacity: Float[Tensor, "height width"],
    seen: Bool[Tensor, "height width"],
    found: Reprojected,
    views: int,
) -> Float[Tensor, "reading height width"]:
    """The inputs of the network for one picture.

    Depths of a field are wrong by some percent. The support views show the same colour at a point only if it lies on
    the surface (plane sweeping, Collins 1996). So they are compared at several points of each ray, and what they show
    there is averaged by how well they agree.

    Args:
        image: the picture of the field.
        opacity: of the field.
        seen: the pixels that are corrected.
        found: what support views show at each of DEPTH_OFFSETS of these pixels, (offset, pixel, value).
        views: number of support views.
    """
    disagreement = _in_windows(found.image_variance[..., 0], seen)[..., None]
    likelihood = torch.softmax(-disagreement / DISAGREEMENT_SCALE, 0)
    best = found.map(lambda values: (likelihood * values).sum(0))
    colours, part = image[:, seen].T, covered(opacity[seen])[:, None]
    read = [
        colours - 0.5,
        part * found.residual[len(DEPTH_OFFSETS) // 2],
        part * best.residual,
        part * (best.image - colours) * best.weight / (best.weight + DOUBT),
        opacity[seen][:, None],
        best.residual_variance.sqrt(),
        best.image_variance.sqrt(),
        torch.full_like(best.weight, math.log2(views) / 5),
    ]
    result = image.new_zeros(READINGS, *image.shape[1:])
    result[COLOUR] = image - 0.5
    result[:, seen] = torch.cat(read, 1).T.to(result)
    return result


def _in_windows(values: Float[Tensor, "depth pixel"], seen: Bool[Tensor, "height width"]) -> Tensor:
    """The mean over the seen pixels of the window around each seen pixel."""
    maps = values.new_zeros(len(values) + 1, *seen.shape)
    maps[:-1, seen], maps[-1, seen] = values, 1
    sums = torch.nn.functional.avg_pool2d(maps[None], WINDOW, 1, WINDOW // 2)[0, :, seen]
    return sums[:-1] / sums[-1]


class CorrectionNetwork(nn.Module):
    """A convolutional network of the residual correction of pictures.

    There are three candidates for the correction of a pixel: the residuals at the depth of the field, those at the
    depths where the support views agree best, and the difference between the colours of the images there and the
    picture. The correction is their weighted sum plus a free term; the network computes weights and term.

    It is trained by `training.correction`, on objects that the field was not trained on, and by nothing else. Before
    training it adds the second candidate.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(READINGS, WIDTH, 3, padding=1)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.ReLU(),
                nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
                nn.ReLU(),
                nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            )
            for _ in range(BLOCKS)
        )
        last = nn.Conv2d(WIDTH, len(INITIAL_WEIGHTS) + 3, 3, padding=1)
        nn.init.zeros_(last.weight)
        assert last.bias is not None
        nn.init.zeros_(last.bias)
        self.last = nn.Sequential(nn.ReLU(), last)
        self.requires_grad_(requires_grad=False)

    def forward(self, read: Float[Tensor, "view 16 height width"]) -> Float[Tensor, "view 3 height width"]:
        """What is added to the colours of pictures; 0 where they are not corrected.

        Args:
            read: the results of `readings`.
        """
        seen = read[:, OPACITY] > MIN_CORRECTED_OPACITY
        result = read.new_zeros(len(read), 3, *read.shape[2:])
        box = _box(seen.any(0)[0])
        if box is None:
            return result
        within = read[:, :, *box]
        hidden = self.first(within)
        for block in self.blocks:
            hidden = hidden + block(hidden)
        weights, free = self.last(hidden).split([len(INITIAL_WEIGHTS), 3], 1)
        weights = weights + weights.new_tensor(INITIAL_WEIGHTS)[:, None, None]
        candidates = within[:, CANDIDATES].unflatten(1, (-1, 3))
        added = (weights[:, :, None] * candidates).sum(1) + OUTPUT_SCALE * free
        result[:, :, *box] = seen[:, :, *box] * added
        return result


def _box(seen: Bool[Tensor, "height width"]) -> tuple[slice, slice] | None:
    """The rectangle of pixels that an output for a seen pixel depends on; None if no pixel is seen."""
    rows, columns = seen.any(1).nonzero()[:, 0], seen.any(0).nonzero()[:, 0]
    if not len(rows):
        return None
    top, left = (max(0, int(each[0]) - REACH) for each in (rows, columns))
    return slice(top, int(rows[-1]) + REACH + 1), slice(left, int(columns[-1]) + REACH + 1)
