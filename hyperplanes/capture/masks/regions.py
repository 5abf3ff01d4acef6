"""Clean masks: steepen soft edges, remove small regions, fill small holes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage.measure import label

__all__ = ["cleaned", "connected_regions", "firm"]

STEEPNESS = 4.0
SPECK = 0.05  # of the area of the largest region: smaller regions are removed
PINHOLE = 0.002  # of the area of the remaining regions: smaller holes are filled


def firm(probability: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Opacity from a probability: 0 up to 3/8, 1 from 5/8 on, so that soft borders do not count as the object.

    >>> firm(np.array([[0.3, 0.5, 0.7]])).tolist()
    [[0.0, 0.5, 1.0]]
    """
    return ((probability - 0.5) * STEEPNESS + 0.5).clip(0, 1)


def connected_regions(mask: Bool[np.ndarray, "height width"]) -> tuple[np.ndarray, int]:
    """The number of the region of each pixel, from 1, or 0 outside the mask; and the number of regions."""
    labels = np.asarray(label(mask, connectivity=1))
    return labels, int(labels.max(initial=0))


def cleaned(opacity: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """The opacity without regions that are far smaller than the largest one, and with small holes filled."""
    labels, count = connected_regions(opacity > 0.5)
    if not count:
        return np.zeros_like(opacity)
    sizes = ndimage.sum_labels(np.ones_like(labels), labels, range(1, count + 1))
    kept = np.isin(labels, 1 + np.flatnonzero(sizes >= SPECK * sizes.max()))
    result = np.where(ndimage.binary_dilation(kept, iterations=2), opacity, 0.0)
    holes, count = connected_regions(result <= 0.5)
    if count > 1:
        sizes = ndimage.sum_labels(np.ones_like(holes), holes, range(1, count + 1))
        result[np.isin(holes, 1 + np.flatnonzero(sizes <= PINHOLE * kept.sum()))] = 1.0
    return result
