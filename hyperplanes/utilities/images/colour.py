"""Conversion between sRGB, for storage and display, and linear light, for computation (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["linear_from_srgb", "srgb_from_linear"]

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
