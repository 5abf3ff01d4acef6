"""Pictures for a page: files as data URIs, and error maps."""

from __future__ import annotations

import base64

import numpy as np
import numpy.typing as npt

from hyperplanes.experiments.page.content import Pixels
from hyperplanes.utilities.files.encoding import encode_png

__all__ = ["ERROR_SCALE", "colour_scale", "error_map", "gradient", "inline", "inline_png"]

ERROR_SCALE = 0.25
"""The difference that has the last colour of the scale."""

_ANCHORS = ("#ffffff", "#fde8c8", "#f9bd74", "#ec7b3a", "#c5402d", "#7f1833", "#2c0b28")
"""Colours from white, for no error, to dark, in equal steps of lightness."""


def colour_scale(values: npt.NDArray[np.floating]) -> Pixels:
    """The colours (..., 3) of values, interpolated between anchors; values outside [0, 1] are clamped.

    >>> colour_scale(np.array([0.0, 1.0])).tolist()
    [[255, 255, 255], [44, 11, 40]]
    """
    channels = zip(*(bytes.fromhex(hue[1:]) for hue in _ANCHORS), strict=True)
    places = np.linspace(0, 1, len(_ANCHORS))
    return np.round(np.stack([np.interp(values, places, each) for each in channels], -1)).astype(np.uint8)


def error_map(prediction: Pixels, truth: Pixels) -> Pixels:
    """The absolute difference, averaged over the channels, as colours of the scale from 0 to ERROR_SCALE.

    Raises:
        ValueError: pictures of different sizes.
    """
    if prediction.shape != truth.shape:
        raise ValueError(f"prediction: expected shape {truth.shape}, got {prediction.shape}")
    difference = np.abs(prediction.astype(np.float64) - truth.astype(np.float64)).mean(-1) / 255
    return colour_scale(difference / ERROR_SCALE)


def gradient() -> str:
    """The colour scale as a CSS gradient."""
    return f"linear-gradient(90deg, {', '.join(_ANCHORS)})"


def inline(content: bytes, kind: str) -> str:
    """A file as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def inline_png(pixels: Pixels) -> str:
    """A picture as a data URI."""
    return inline(encode_png(pixels, small=True), "png")
