"""Colours of PLY and OFF files, which state them in many types and ranges."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["rgba_bytes"]


def rgba_bytes(colours: npt.NDArray[Any], alpha: npt.NDArray[Any] | None) -> npt.NDArray[np.uint8]:
    """RGBA of colours (item, 3) and their alpha (item,) or (item, 0 or 1)."""
    rgba = np.full((len(colours), 4), 255, dtype=np.uint8)
    rgba[:, :3] = _of_255(colours)
    if alpha is not None and alpha.size:
        rgba[:, 3] = _of_255(alpha.reshape(-1))
    return rgba


def _of_255(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values scaled to 0 to 255: floats from 1, or from 255 if any is above 1; integers from the largest of their type.

    Integers of at most 255 are not scaled: many programs write them in wider types.
    """
    values = np.where(np.isfinite(values), values, 0)
    largest = values.max(initial=0)
    if values.dtype.kind == "f":
        top = 255.0 if largest > 1 else 1.0
    else:
        top = float(np.iinfo(values.dtype).max) if largest > 255 else 255.0
    return np.clip(np.round(values * (255.0 / top)), 0, 255)
