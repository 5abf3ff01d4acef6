"""Materials of parts: plain colours and small procedural textures.

Colours are sRGB, 0 to 255. A `Material` is an image; a plain colour is an image of one pixel. Patterns are drawn with a
`numpy.random.Generator`, so the same generator state gives the same pixels.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

__all__ = ["Colour", "Material", "brighten", "canvas", "pixel_centres", "plain", "tint"]

Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Material:
    """A painted surface.

    Attributes:
        name: name of the material.
        image: pixels (h, w, 3), uint8 sRGB, row 0 at the top (v = 1). One pixel for a plain colour.
    """

    name: str
    image: np.ndarray


def plain(colour: Colour, name: str = "plain") -> Material:
    """A single colour."""
    return Material(name, np.array([[colour]], dtype=np.uint8))


def canvas(colour: Colour, height: int, width: int) -> np.ndarray:
    """An image (height, width, 3) of one colour, to draw on."""
    return np.tile(np.array(colour, dtype=np.uint8), (height, width, 1))


def pixel_centres(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (u, v upwards) of the centres of pixels, each (height, width) in (0, 1)."""
    row, column = np.mgrid[0:height, 0:width]
    return (column + 0.5) / width, 1 - (row + 0.5) / height


def brighten(colour: Colour, factor: float) -> Colour:
    """A colour times a factor, clipped to the range; factors below 1 darken it."""
    red, green, blue = (min(255, max(0, round(channel * factor))) for channel in colour)
    return red, green, blue


def tint(rng: np.random.Generator, hue: float, saturation: float, value: float, spread: float = 0.05) -> Colour:
    """A colour near the given hue, saturation and value, each in [0, 1], moved by at most `spread`."""
    dh, ds, dv = rng.uniform(-spread, spread, 3)
    rgb = colorsys.hsv_to_rgb((hue + 0.5 * dh) % 1, min(1, max(0, saturation + ds)), min(1, max(0, value + dv)))
    red, green, blue = (round(255 * channel) for channel in rgb)
    return red, green, blue
