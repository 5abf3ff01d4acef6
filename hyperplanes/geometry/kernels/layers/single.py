"""The CPU kernel of fully connected layers with ReLU: all layers of a block of points, one block after the other.

The values of a layer stay in the caches until the next one reads them. TILE points by COLUMNS values are computed at
once, in registers, so that each weight and each input that is loaded is used several times. The weights of COLUMNS
values lie one input after the other (`pack_weights`).
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from hyperplanes.geometry.kernels.layers.vectors import LANES, BFloat, rounded
from hyperplanes.geometry.kernels.lookup.blocks import inlined

__all__ = ["BLOCK", "COLUMNS", "MAX_LAYER_WIDTH", "TILE", "copy_block", "layers", "multiply_tile", "pack_weights"]

TILE, VECTORS = 6, 4  # 24 of the 32 registers of AVX-512 hold sums, four weights
COLUMNS = LANES * VECTORS
BLOCK = 10 * TILE
MAX_LAYER_WIDTH = 512  # PyTorch is as fast for wider layers

_FUSED = {"flags": ("contract",)}


def pack_weights(weight: Float[Tensor, "output input"], first: int) -> Float[Tensor, " number"]:
    """The weights of a layer in the order in which the kernel reads them.

    Args:
        weight: with a multiple of COLUMNS outputs.
        first: number of inputs that come first; not used here.
    """
    return weight.unflatten(0, (-1, COLUMNS)).transpose(1, 2).flatten()


def _add_product(builder, total, one, other):
    """A vector of sums plus products of single precision, or of pairs of bfloat16."""
    if one.type == total.type:
        return builder.fadd(total, builder.fmul(one, other, **_FUSED), **_FUSED)
    pairs = ir.VectorType(BFloat(), 2 * LANES)
    kind = ir.FunctionType(total.type, [total.type, pairs, pairs])
    instruction = builder.module.declare_intrinsic("llvm.x86.avx512bf16.dpbf16ps.512", (), kind)
    return builder.call(instruction, [total, builder.bitcast(one, pairs), builder.bitcast(other, pairs)])


def _sums(builder, sums, values, weights, count):
    """TILE times VECTORS vectors of sums, plus the products of `count` inputs and their weights.

    `values` are pointers to the first input of each point, `weights` one to the first of the weights. An input is a
    number in single precision, or a pair of bfloat16.
    """
    kind, index, loaded = sums[0].type, count.type, ir.VectorType(weights.type.pointee, LANES)
    before = builder.block
    body, after = builder.append_basic_block("multiply"), builder.append_basic_block("multiplied")
    builder.cbranch(builder.icmp_signed(">", count, index(0)), body, after)
    builder.position_at_end(body)
    place = builder.phi(index)
    place.add_incoming(index(0), before)
    held = []
    for value in sums:
        held.append(builder.phi(kind))
        held[-1].add_incoming(value, before)
    first = builder.gep(weights, [builder.mul(place, index(COLUMNS))])
    vectors = [_vector(builder, first, index(LANES * vector)) for vector in range(VECTORS)]
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    added = []
    for point, pointer in enumerate(values):
        value = builder.load(builder.gep(pointer, [place]), align=4)
        single = builder.insert_element(ir.Constant(loaded, ir.Undefined), value, ir.IntType(32)(0))
        spread = builder.shuffle_vector(single, single, zeros)
        for vector, weight in enumerate(vectors):
            added.append(_add_product(builder, held[VECTORS * point + vector], spread, weight))
    following = builder.add(place, index(1))
    place.add_incoming(following, body)
    for value, new in zip(held, added, strict=True):
        value.add_incoming(new, body)
    builder.cbranch(builder.icmp_signed("<", following, count), body, after)
    builder.position_at_end(after)
    result = []
    for old, new in zip(sums, added, strict=True):
        result.append(builder.phi(kind))
        result[-1].add_incoming(old, before)
        result[-1].add_incoming(new, body)
    return result


def _vector(builder, pointer, at):
    wide = ir.VectorType(pointer.type.pointee, LANES).as_pointer()
    return builder.load(builder.bitcast(builder.gep(pointer, [at]), wide), align=4)


@intrinsic
def multiply_tile(  # noqa: PLR0913
    typing_context, given, at, inputs, used, hidden, row, width, also, weights, first, biases, bias, out, to
):
    """COLUMNS values of a layer at TILE points, after ReLU, into `out` from `to` on, `width` apart.

    They are sums over `used` inputs in `given` from `at` on, `inputs` apart, over `also` ones in `hidden` from `row`
    on, `width` apart, and biases. Where `given`, `hidden` and `weights` are of int32, an input is a pair of bfloat16;
    where `out` is, values are rounded to bfloat16 and `to` counts pairs. Points are as many values apart in `out` as in
    `hidden`.
    """

    def generate(context, builder, signature, arguments):
        def pointer(array, offset):
            data = context.make_array(signature.args[array])(context, builder, arguments[array]).data
            return builder.gep(data, [arguments[offset]])

        inputs, used, width, also = (arguments[place] for place in (2, 3, 6, 7))
        index = used.type
        weights, biases = pointer(8, 9), pointer(10, 11)
        start = [_vector(builder, biases, index(LANES * vector)) for vector in range(VECTORS)]
        sums = start * TILE
        rows = [builder.gep(pointer(0, 1), [builder.mul(inputs, index(point))]) for point in range(TILE)]
        sums = _sums(builder, sums, rows, weights, used)
        rows = [builder.gep(pointer(4, 5), [builder.mul(width, index(point))]) for point in range(TILE)]
        rest = builder.gep(weights, [builder.mul(used, index(COLUMNS))])
        sums = _sums(builder, sums, rows, rest, also)
        zero = ir.Constant(sums[0].type, [0.0] * LANES)
        target, pairs = pointer(12, 13), signature.args[12].dtype == types.int32
        of_pairs = signature.args[4].dtype == types.int32
        pitch = builder.mul(width, index(2)) if of_pairs and not pairs else width
        for place, value in enumerate(sums):
            point, vector = divmod(place, VECTORS)
            kept = builder.select(builder.fcmp_ordered("<=", value, zero), zero, value)  # NaN stays
            kept = rounded(builder, kept) if pairs else kept
            there = builder.add(builder.mul(pitch, index(point)), index((LANES // 2 if pairs else LANES) * vector))
            builder.store(kept, builder.bitcast(builder.gep(target, [there]), kept.type.as_pointer()), align=4)
        return context.get_dummy_value()

    index = types.int64
    return types.void(
        given, index, index, index, hidden, index, index, index, weights, index, biases, index, out, index
    ), generate


@inlined
@no_type_check
def copy_block(given, first, count, block, size):
    """Copies the numbers of points from `first` on into `block`, `size` apart, in the order of memory."""
    if given.strides[0] > given.strides[1]:
        for point in range(count):
            for number in range(given.shape[1]):
                block[point * size + number] = given[first + point, number]
    else:
        for number in range(given.shape[1]):
            for point in range(count):
                block[point * size + number] = given[first + point, number]


@no_type_check
def layers(given, weights, biases, shape, out, start, stop):
    """The values of points start..stop after all layers, into `out`.

    `given` are the inputs of points, `weights` those of all layers as `pack_weights` makes them, `biases` theirs.
    `shape` is the number of layers, their width, and the layer that reads the inputs before the values of the previous
    layer; 0 for none.
    """
    depth, width, skip = shape
    size = given.shape[1]
    inputs = np.zeros(BLOCK * size, np.float32)
    one, other = np.zeros(BLOCK * width, np.float32), np.zeros(BLOCK * width, np.float32)
    for first in range(start, stop, BLOCK):
        count = min(BLOCK, stop - first)
        copy_block(given, first, count, inputs, size)
        read = 0
        for layer in range(depth):
            one, other = other, one  # `one` is written, `other` is read
            used, also = size if layer == 0 or layer == skip else 0, width if layer > 0 else 0
            for column in range(0, width, COLUMNS):
                for point in range(0, count, TILE):
                    multiply_tile(
                        inputs, point * size, size, used, other, point * width, width, also, weights, read, biases,
                        layer * width + column, one, point * width + column,
                    )  # fmt: skip
                read += COLUMNS * (used + also)
        for point in range(count):
            for number in range(width):
                out[first + point, number] = one[point * width + number]
