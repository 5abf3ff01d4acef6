"""Images are floating-point numbers in [0, 1]: 8-bit values and NaN are refused."""

from __future__ import annotations

import torch
from torch import Tensor

from hyperplanes.utilities.messages.arguments import kind_of
from hyperplanes.utilities.tensors.transforms import are_plain

__all__ = ["check_image_range"]

MAX_PIXEL_VALUE = 1.5
"""Largest pixel value accepted as an image in [0, 1]; rendered values may overshoot slightly."""


def check_image_range(name: str, values: object) -> None:
    """Refuse pictures or masks that are not floating-point numbers in [0, 1].

    Args:
        name: the name of the argument, for the message.
        values: the argument.

    Raises:
        ValueError: not such a tensor, or values out of range, such as 0 to 255 or NaN. Tensors under a transform of
            PyTorch pass, because their values cannot be read.
    """
    if not isinstance(values, Tensor) or not values.is_floating_point():
        found, hint = kind_of(values), "; torch.from_numpy(x).float() / 255 converts 8-bit pixels"
        if isinstance(values, Tensor) and values.dtype == torch.bool:
            hint = "; x.float() converts booleans"
        raise ValueError(f"{name}: expected a tensor of floating-point numbers in [0, 1], got {found}{hint}")
    if not values.numel() or values.is_meta or not are_plain(values):
        return
    low, high = (float(value) for value in values.detach().aminmax())
    if not (1 - MAX_PIXEL_VALUE <= low and high <= MAX_PIXEL_VALUE):
        found = f"{low:g} to {high:g}; divide 8-bit pixels by 255" if low == low else "NaN"
        raise ValueError(f"{name}: expected finite numbers in [0, 1], got {found}")
