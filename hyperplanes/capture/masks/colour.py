"""Masks by the colour of a plain background, such as a green screen or a sheet of paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from skimage.color import rgb2lab

from hyperplanes.capture.masks.regions import cleaned, connected_regions

__all__ = ["PlainBackground", "is_plain"]

BORDER_WIDTH = 0.03  # of the shorter side: width of the border
BACKGROUND_DISTANCE = 10.0  # in CIE Lab, up to which a pixel is background
OBJECT_DISTANCE = 18.0  # and from which on it is the object
PLAIN_BORDER, PLAIN_PICTURES = 0.7, 0.8  # least shares of the border and of the images that have to be plain


class PlainBackground:
    """Masks of all pixels whose colour differs from that of the image's border.

    Regions of about the border's colour that the object encloses belong to it, unless they match the colour closely, as
    holes do.
    """

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        """Opacity in [0, 1]."""
        lab = rgb2lab(picture)
        distance = np.linalg.norm(lab - _border_colour(lab), axis=-1)
        opacity = ((distance - BACKGROUND_DISTANCE) / (OBJECT_DISTANCE - BACKGROUND_DISTANCE)).clip(0, 1)
        labels, _ = connected_regions(opacity < 0.5)
        outer = np.unique(labels[_border(labels.shape)])
        reached = np.isin(labels, outer[outer > 0])
        enclosed = (opacity < 0.5) & ~reached & (distance > BACKGROUND_DISTANCE / 2)  # holes are closer
        return cleaned(np.where(enclosed, 1.0, opacity))


def is_plain(pictures: Sequence[UInt8[np.ndarray, "height width 3"]]) -> bool:
    """Whether at least 80 % of the images have a border of one colour, which may differ between images."""
    plain = 0
    for picture in pictures:
        lab = rgb2lab(picture[:: max(1, min(picture.shape[:2]) // 200), :: max(1, min(picture.shape[:2]) // 200)])
        border = lab[_border(lab.shape[:2])]
        distance = np.linalg.norm(border - _border_colour(lab), axis=-1)
        plain += float((distance < BACKGROUND_DISTANCE).mean()) >= PLAIN_BORDER
    return plain >= PLAIN_PICTURES * len(pictures)


def _border(size: tuple[int, ...]) -> np.ndarray:
    """Which pixels belong to the border, of a width of BORDER_WIDTH."""
    width = max(1, round(BORDER_WIDTH * min(size[:2])))
    result = np.ones(size[:2], bool)
    result[width:-width, width:-width] = False
    return result


def _border_colour(lab: np.ndarray) -> np.ndarray:
    """The median colour of the border."""
    return np.median(lab[_border(lab.shape[:2])], axis=0)
