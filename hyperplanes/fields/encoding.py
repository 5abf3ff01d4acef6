"""The positional encoding of NeRF."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.chosen_views import OCTAVES

__all__ = ["encoded_size", "encode"]


def encoded_size(frequencies: int) -> int:
    """Length of an encoded point or direction."""
    return 3 * (1 + 2 * frequencies)


def encode(values: Float[Tensor, "*vectors"], frequencies: int, dim: int = -1) -> Float[Tensor, "*encoded"]:
    """(v, sin(2^0 v), ..., sin(2^(L-1) v), cos(2^0 v), ..., cos(2^(L-1) v)) (NeRF, Eq. 4, without its factor pi).

    Only the first sine and cosine of every OCTAVES octaves are computed; the others follow by angle doubling, which
    also multiplies errors. Half precision is computed in single precision.

    Args:
        values: coordinates in about [-1, 1].
        frequencies: L.
        dim: the dimension of vectors and of their encodings.

    >>> encode(torch.tensor([0.0, 0.0, 0.0]), 1).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    """
    if frequencies == 0:
        return values
    exact = values.to(torch.promote_types(values.dtype, torch.float32))
    sine: list[Tensor] = []
    cosine: list[Tensor] = []
    for octave in range(frequencies):
        if octave % OCTAVES == 0:
            angle = exact * 2**octave
            sine.append(angle.sin())
            cosine.append(angle.cos())
        else:
            sine_now, cosine_now = sine[-1], cosine[-1]
            sine.append(2 * sine_now * cosine_now)
            cosine.append(1 - 2 * sine_now.square())
    return torch.cat([values, *(each.to(values) for each in (*sine, *cosine))], dim)
