"""The kernel of `layers` for Intel's AMX, whose instructions multiply tiles of 16 rows in bfloat16.

A number in single precision is the sum of two in bfloat16, up to 2**-17 of it. Of the four products of two such sums
the three largest are added up in single precision: values differ from those in single precision by some 1e-5 to 3e-5 of
the largest. Numbers that are infinite, or above 3.38e38, give NaN, and those below 1e-38 count as zero.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int16
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor
from torch.nn.functional import pad

from hyperplanes.geometry.kernels.layers.single import copy_block
from hyperplanes.geometry.kernels.layers.vectors import LANES, address_of, read_vector, rounded, rounding, write_vector
from hyperplanes.geometry.kernels.lookup.blocks import inlined

__all__ = ["COLUMNS", "MAX_LAYER_WIDTH", "layers", "multiply_layers", "pack_weights"]

ROWS = LANES  # of a tile, each a vector of as many numbers in single precision
TILE = COLUMNS = 2 * ROWS  # points and columns of four tiles, and inputs of one product
BLOCK = 5 * TILE  # points that go through all layers together
MAX_LAYER_WIDTH = 2048  # no wider layers were measured

_BYTE, _LONG = ir.IntType(8), ir.IntType(64)


def pack_weights(weight: Float[Tensor, "output input"], first: int, parts: int = 2) -> Int16[Tensor, " number"]:
    """The weights of a layer in the order in which the kernel reads them.

    Args:
        weight: with a multiple of TILE outputs.
        first: number of inputs that come first, which are padded with zeros to a multiple of TILE. The number of the
            others must be a multiple of it.
        parts: number of bfloat16 summands of a weight, 1 or 2.
    """
    filled = torch.cat([pad(weight[:, :first], (0, -first % TILE)), weight[:, first:]], 1)
    # blocks of TILE columns in two tiles, with pairs of inputs side by side
    tiles = filled.reshape(len(weight) // TILE, 2, ROWS, -1, ROWS, 2).permute(0, 3, 1, 4, 2, 5)
    high = tiles.bfloat16()
    return torch.stack([high, (tiles - high).bfloat16()][:parts], 2).flatten().view(torch.int16)


def _call(builder, name, *arguments):
    """An instruction on tile registers, which are given by their numbers."""
    numbers = [ir.Constant(_BYTE, each) if isinstance(each, int) else each for each in arguments]
    kind = ir.FunctionType(ir.VoidType(), [each.type for each in numbers])
    builder.call(builder.module.declare_intrinsic(f"llvm.x86.{name}", (), kind), numbers)


@intrinsic
def _configure(typing_context, shapes):
    """Configure the tile registers with shapes as the processor's manual describes them."""

    def generate(context, builder, signature, arguments):
        _call(builder, "ldtilecfg", address_of(context, builder, signature.args[0], arguments[0]))
        return context.get_dummy_value()

    return types.void(shapes), generate


@intrinsic
def _release(typing_context):
    """Release the tile registers."""

    def generate(context, builder, signature, arguments):
        _call(builder, "tilerelease")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def _begin(typing_context, biases, bias):
    """Fill tiles 0 to 3, TILE points by TILE columns, with the biases of the columns."""

    def generate(context, builder, signature, arguments):
        address = address_of(context, builder, signature.args[0], *arguments)
        for tile in range(4):
            column = builder.gep(address, [_LONG(tile % 2 * ROWS * 4)])
            _call(builder, "tileloadd64", tile, column, _LONG(0))  # the same row for all
        return context.get_dummy_value()

    return types.void(biases, types.int64), generate


def _multiplying(parts):
    @intrinsic
    def multiply(typing_context, values, at, size, weights, first):
        """Add the products of TILE points, from TILE inputs on, with weights.

        The high halves of a point lie from `at` on, the low ones, where there are two parts, `size` further, and the
        next point after `parts * size`.
        """

        def generate(context, builder, signature, arguments):
            size = arguments[2]
            address = address_of(context, builder, signature.args[0], *arguments[:2])
            weights = address_of(context, builder, signature.args[3], *arguments[3:])
            pitch, low = builder.mul(size, _LONG(2 * parts)), builder.mul(size, _LONG(2))

            def load_values(start):
                for tile in range(2):
                    rows = builder.mul(pitch, _LONG(tile * ROWS))
                    _call(builder, "tileloadd64", 4 + tile, builder.gep(start, [rows]), pitch)

            def load_weights(half):
                for tile in range(2):
                    place = builder.gep(weights, [_LONG((2 * half + tile) * 1024)])
                    _call(builder, "tileloadd64", 6 + tile, place, _LONG(64))

            def add():
                for tile in range(4):
                    _call(builder, "tdpbf16ps", tile, 4 + tile // 2, 6 + tile % 2)

            load_values(address)
            if parts == 2:
                load_weights(1)
                add()
            load_weights(0)
            add()
            if parts == 2:
                load_values(builder.gep(address, [low]))
                add()
            return context.get_dummy_value()

        index = types.int64
        return types.void(values, index, index, weights, index), generate

    return multiply


_multiply, _multiply_rounded = _multiplying(2), _multiplying(1)


@intrinsic
def _end(typing_context, sums):
    """Write tiles 0 to 3 as TILE rows of TILE."""

    def generate(context, builder, signature, arguments):
        address = address_of(context, builder, signature.args[0], arguments[0])
        for tile in range(4):
            place = tile // 2 * ROWS * TILE + tile % 2 * ROWS
            _call(builder, "tilestored64", tile, builder.gep(address, [_LONG(place * 4)]), _LONG(TILE * 4))
        return context.get_dummy_value()

    return types.void(sums), generate


def _halving(least):
    @intrinsic
    def halve(typing_context, numbers, at, parts, high, low):
        """A vector of numbers from `at` on, not below `least`, as bfloat16 from `high` and from `low` on."""

        def generate(context, builder, signature, arguments):
            value = read_vector(context, builder, signature.args[0], arguments[0], arguments[1], least)
            wide = ir.VectorType(ir.IntType(32), ROWS)
            upper = rounded(builder, value)
            write_vector(context, builder, signature.args[2], arguments[2], arguments[3], upper)
            again = builder.shl(builder.zext(upper, wide), ir.Constant(wide, [16] * ROWS))
            rest = rounded(builder, builder.fsub(value, builder.bitcast(again, value.type)))
            write_vector(context, builder, signature.args[2], arguments[2], arguments[4], rest)
            return context.get_dummy_value()

        index = types.int64
        return types.void(numbers, index, parts, index, index), generate

    return halve


_halve, _halve_activated = _halving(None), _halving(0.0)
_round, _round_activated = rounding(None), rounding(0.0)


@intrinsic
def _activate(typing_context, numbers, at, out, place):
    """A vector of numbers from `at` on, after ReLU, into `out` from `place` on."""

    def generate(context, builder, signature, arguments):
        value = read_vector(context, builder, signature.args[0], arguments[0], arguments[1], 0.0)
        write_vector(context, builder, signature.args[2], arguments[2], arguments[3], value)
        return context.get_dummy_value()

    return types.void(numbers, types.int64, out, types.int64), generate


@inlined
@no_type_check
def multiply_layers(given, weights, biases, shape, out, start, stop, parts):  # noqa: PLR0913
    """The kernel, with factors that are sums of two numbers in bfloat16, or one number alone."""
    depth, width, skip = shape
    size = (given.shape[1] + TILE - 1) // TILE * TILE
    inputs = np.zeros(BLOCK * parts * size, np.int16)
    one, other = np.zeros(BLOCK * parts * width, np.int16), np.zeros(BLOCK * parts * width, np.int16)
    values, sums = np.zeros(BLOCK * size, np.float32), np.zeros(TILE * TILE, np.float32)
    shapes = np.zeros(64, np.uint8)
    shapes[0] = 1
    for tile in range(8):
        shapes[16 + 2 * tile] = 4 * ROWS  # bytes of a row
        shapes[48 + tile] = ROWS
    _configure(shapes)
    for first in range(start, stop, BLOCK):
        count = min(BLOCK, stop - first)
        copy_block(given, first, count, values, size)
        for number in range(0, count * size, ROWS):
            at = number + number // size * size * (parts - 1)  # after the low halves of the points before
            if parts == 2:
                _halve(values, number, inputs, at, at + size)
            else:
                _round(values, number, inputs, at)
        read = 0
        for layer in range(depth):
            one, other = other, one  # `one` is written, `other` is read
            used, also = size if layer == 0 or layer == skip else 0, width if layer > 0 else 0
            for column in range(0, width, TILE):
                for point in range(0, count, TILE):
                    _begin(biases, layer * width + column)
                    place = read
                    for number in range(0, used, TILE):
                        if parts == 2:
                            _multiply(inputs, parts * point * size + number, size, weights, place)
                        else:
                            _multiply_rounded(inputs, parts * point * size + number, size, weights, place)
                        place += parts * TILE * TILE
                    for number in range(0, also, TILE):
                        if parts == 2:
                            _multiply(other, parts * point * width + number, width, weights, place)
                        else:
                            _multiply_rounded(other, parts * point * width + number, width, weights, place)
                        place += parts * TILE * TILE
                    _end(sums)
                    for line in range(min(TILE, count - point)):
                        for number in range(0, TILE, ROWS):
                            at = line * TILE + number
                            place = parts * (point + line) * width + column + number
                            if layer == depth - 1:
                                _activate(sums, at, out, (first + point + line) * width + column + number)
                            elif parts == 2:
                                _halve_activated(sums, at, one, place, place + width)
                            else:
                                _round_activated(sums, at, one, place)
                read += parts * TILE * (used + also)
    _release()


@no_type_check
def layers(given, weights, biases, shape, out, start, stop):
    """The values of points start..stop after all layers, into `out`; arguments as those of the kernel in `layers`.

    `weights` are those of all layers as `pack_weights` makes them.
    """
    multiply_layers(given, weights, biases, shape, out, start, stop, 2)
