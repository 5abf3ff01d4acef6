"""The kernel of `layers.amx` in mixed precision: factors are rounded to bfloat16, as those of `layers.bfloat16`."""

from __future__ import annotations

from typing import no_type_check

from jaxtyping import Float, Int16
from torch import Tensor

from hyperplanes.geometry.kernels.layers import amx
from hyperplanes.geometry.kernels.layers.amx import COLUMNS, MAX_LAYER_WIDTH, multiply_layers

__all__ = ["COLUMNS", "MAX_LAYER_WIDTH", "layers", "pack_weights"]


def pack_weights(weight: Float[Tensor, "output input"], first: int) -> Int16[Tensor, " number"]:
    """The weights of a layer in the order in which the kernel reads them; arguments as those of `layers.amx`."""
    return amx.pack_weights(weight, first, parts=1)


@no_type_check
def layers(given, weights, biases, shape, out, start, stop):
    """The values of points start..stop after all layers, into `out`; arguments as those of the kernel in `layers`.

    `weights` are those of all layers as `pack_weights` makes them.
    """
    multiply_layers(given, weights, biases, shape, out, start, stop, 1)
