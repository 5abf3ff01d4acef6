"""View penalties for a point: depth behind the visible surface, incomplete masks, borders that crop the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.chosen_views import (
    BORDER_MARGIN,
    BORDER_PENALTY,
    BORDER_POLE,
    INVISIBLE_PENALTY,
    OPAQUE_MASK,
    PENALTY_RADIANS,
    Penalties,
)

__all__ = ["ViewPenalties", "fading", "margin", "margins"]

MIN_CROPPED_SHARE = 0.02  # of the shorter side: a border with that many object pixels along it crops the object


@dataclass(frozen=True)
class ViewPenalties:
    """The penalties of the views of planes.

    Attributes:
        offsets: added to the penalty of each view wherever it shows a point.
        margins: as `margins` returns them.
        penalties: costs of depth and of masks.
    """

    offsets: Float[Tensor, " view"]
    margins: Float[Tensor, "view 4"]
    penalties: Penalties

    @cached_property
    def _cut(self) -> bool:
        """Whether a border crops the object in any view."""
        return bool(self.margins.any())

    def limits(self, size: Sequence[int]) -> list[float]:
        """What the kernels read of the penalties, apart from offsets and margins.

        Args:
            size: height and width of the pictures.
        """
        own = self.penalties
        of_views = [own.deepest, own.partly, OPAQUE_MASK, INVISIBLE_PENALTY, PENALTY_RADIANS]
        return [*of_views, own.steep, own.highest, own.least, 1 / margin(*size), BORDER_PENALTY, BORDER_POLE]

    def penalty(
        self,
        behind: Float[Tensor, "point view"],
        coverage: Float[Tensor, "point view"],
        coordinates: Float[Tensor, "point view 2"],
        size: Sequence[int],
    ) -> Float[Tensor, "point view"]:
        """The penalty of each view that shows a point; the kernel `choosing.choose` computes the same.

        Args:
            behind: depth of the point behind the surface that the view sees, less the tolerance, in radii.
            coverage: the opacity of its mask there.
            coordinates: as in `fading`.
            size: as in `fading`.
        """
        own = self.penalties
        penalty = (own.steep * behind).clamp(own.least, own.deepest)
        penalty = (penalty + own.partly * (coverage < OPAQUE_MASK)).clamp_max(own.highest) + self.offsets
        if not self._cut:
            return penalty
        cut = fading(self.margins, coordinates, size)
        return torch.where(cut > 0, penalty.clamp_min(0) + BORDER_PENALTY * cut / (BORDER_POLE - cut), penalty)


def margins(masks: Float[Tensor, "view 1 height width"]) -> Float[Tensor, "view 4"]:
    """Width of the fade-out at the left, right, upper and lower border of each picture, in pixels.

    Args:
        masks: opacity in [0, 1]. A border crops the object where several of its pixels are opaque; a single one may be
            noise, and UNKNOWN_OPACITY, of reflections, do not count.

    Returns:
        Widths; 0 at borders that do not crop the object.
    """
    height, width = masks.shape[2:]
    whole = masks[:, 0] >= OPAQUE_MASK
    borders = whole[:, :, 0], whole[:, :, -1], whole[:, 0], whole[:, -1]
    cut = torch.stack([each.sum(1) >= max(2, MIN_CROPPED_SHARE * min(height, width)) for each in borders], 1)
    return margin(height, width) * cut


def fading(margins: Float[Tensor, "view 4"], coordinates: Float[Tensor, "point view 2"], size: Sequence[int]) -> Tensor:
    """How far points lie in a fade-out margin (point, view): 0 inside all margins, 1 at the border.

    Args:
        margins: of `margins`.
        coordinates: (column, row) in [-1, 1], from the first pixel's centre to the last one's.
        size: height and width of the pictures.
    """
    height, width = size
    last = coordinates.new_tensor([width - 1, height - 1])
    pixels = torch.minimum(((coordinates + 1) * last / 2).clamp_min(0), last)
    inside = torch.stack([pixels, last - pixels], -1).flatten(-2)  # left, right, upper, lower
    return (margins - inside).amax(-1).clamp_min(0) / margin(height, width)


def margin(height: int, width: int) -> float:
    """The width of a margin of a picture of this size, in pixels."""
    return BORDER_MARGIN * min(height, width)
