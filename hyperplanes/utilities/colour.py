"""sRGB, as images are stored and shown, to linear light, in which it is computed, and back (IEC 61966-2-1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

__all__ = ["convert_8bit", "linear_from_srgb", "srgb_from_linear"]

Floats = npt.NDArray[np.float64]


def linear_from_srgb(colours: npt.ArrayLike) -> Floats:
    """Linear light of sRGB values in [0, 1].

    >>> linear_from_srgb([0.0, 0.04045, 1.0]).round(6).tolist()
    [0.0, 0.003131, 1.0]
    """
    value = np.asarray(colours, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: npt.ArrayLike) -> Floats:
    """SRGB values of linear light in [0, 1].

    >>> srgb_from_linear([0.0, 0.0031308, 1.0]).round(5).tolist()
    [0.0, 0.04045, 1.0]
    """
    value = np.asarray(light, dtype=np.float64)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055)


def convert_8bit(
    colours: npt.NDArray[np.uint8], conversion: Callable[[npt.ArrayLike], Floats]
) -> npt.NDArray[np.uint8]:
    """8-bit colours (..., 3 or 4) under one of the conversions above; a fourth channel (alpha) stays.

    >>> convert_8bit(np.array([0, 188, 255, 128], np.uint8), linear_from_srgb).tolist()
    [0, 128, 255, 128]
    >>> convert_8bit(np.array([0, 128, 255, 128], np.uint8), srgb_from_linear).tolist()
    [0, 188, 255, 128]
    """
    result = np.array(colours, dtype=np.uint8)
    result[..., :3] = np.round(conversion(result[..., :3] / 255.0) * 255.0)
    return result
