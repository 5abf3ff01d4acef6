"""The kernel of `layers` in mixed precision: products of bfloat16 by AVX-512, added up in single precision.

Weights and the values between layers are rounded to bfloat16: results differ from single precision by some 0.1 to 1 %
of the largest. Numbers below 1e-38 count as zero.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.nn.functional import pad

from hyperplanes.geometry.kernels.layers.single import BLOCK, COLUMNS, TILE, copy_block, multiply_tile
from hyperplanes.geometry.kernels.layers.vectors import LANES, rounding

__all__ = ["COLUMNS", "MAX_LAYER_WIDTH", "layers", "pack_weights"]

MAX_LAYER_WIDTH = 512  # no wider layers were measured

_round = rounding(None)


def pack_weights(weight: Float[Tensor, "output input"], first: int) -> Int32[Tensor, " pair"]:
    """The weights of a layer in the order in which the kernel reads them.

    Args:
        weight: with a multiple of COLUMNS outputs.
        first: number of inputs that come first, which are padded with a zero to an even number. The number of the
            others must be even.
    """
    filled = torch.cat([pad(weight[:, :first], (0, first % 2)), weight[:, first:]], 1)
    pairs = filled.bfloat16().reshape(len(weight) // COLUMNS, COLUMNS, -1, 2).transpose(1, 2)
    return pairs.flatten().view(torch.int32)


@no_type_check
def layers(given, weights, biases, shape, out, start, stop):
    """The values of points start..stop after all layers, into `out`; arguments as those of the kernel in `layers`.

    `weights` are those of all layers as `pack_weights` makes them.
    """
    depth, width, skip = shape
    size, half = (given.shape[1] + 1) // 2, width // 2  # pairs of a point
    # the last rounded vector may begin at the last number
    values, last = np.zeros(BLOCK * 2 * size + LANES, np.float32), np.zeros(BLOCK * width, np.float32)
    inputs = np.zeros(BLOCK * size + LANES // 2, np.int32)
    one, other = np.zeros(BLOCK * half, np.int32), np.zeros(BLOCK * half, np.int32)
    for first in range(start, stop, BLOCK):
        count = min(BLOCK, stop - first)
        copy_block(given, first, count, values, 2 * size)
        for number in range(0, count * 2 * size, LANES):
            _round(values, number, inputs, number // 2)
        read = 0
        for layer in range(depth):
            one, other = other, one  # `one` is written, `other` is read
            used, also = size if layer == 0 or layer == skip else 0, half if layer > 0 else 0
            for column in range(0, width, COLUMNS):
                for point in range(0, count, TILE):
                    bias = layer * width + column
                    if layer < depth - 1:
                        to = point * half + column // 2
                        multiply_tile(
                            inputs, point * size, size, used, other, point * half, half, also, weights, read, biases,
                            bias, one, to,
                        )  # fmt: skip
                    else:
                        to = point * width + column
                        multiply_tile(
                            inputs, point * size, size, used, other, point * half, half, also, weights, read, biases,
                            bias, last, to,
                        )  # fmt: skip
                read += COLUMNS * (used + also)
        for point in range(count):
            for number in range(width):
                out[first + point, number] = last[point * width + number]
