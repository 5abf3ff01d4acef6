"""Array access and unpacking of bits that let LLVM vectorise a loop over a block of points (numba only).

A loop that reads pixels at computed places and writes results cannot be vectorised unless the compiler knows that the
writes never touch the pixels. `read`, `load` and `store` carry that promise as LLVM `alias.scope` and `noalias`
metadata (LLVM language reference, "noalias and alias.scope metadata"). None of them checks bounds or wraps negative
indices. `bits_of` exists because numba widens 32-bit integer arithmetic to 64 bits, which halves the lanes.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["add_pixels", "bits_of", "load", "read", "store"]


def _scope(module: ir.Module) -> ir.Value:
    domain = module.add_metadata([ir.MetaDataString(module, "hyperplanes lookup")])
    scope = module.add_metadata([ir.MetaDataString(module, "hyperplanes constant inputs"), domain])
    return module.add_metadata([scope])


@intrinsic
def read(typing_context, array, offset, index):
    """array.data[offset + index] of an input that nothing in the kernel writes to."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        value = builder.load(builder.gep(builder.gep(data, [arguments[1]]), [arguments[2]]))
        value.set_metadata("alias.scope", _scope(builder.module))
        return value

    return array.dtype(array, offset, index), generate


@intrinsic
def load(typing_context, array, index):
    """array.data[index] of scratch memory."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        value = builder.load(builder.gep(data, [arguments[1]]))
        value.set_metadata("noalias", _scope(builder.module))
        return value

    return array.dtype(array, index), generate


@intrinsic
def store(typing_context, array, index, value):
    """array.data[index] = value in scratch memory, which is never an input."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        instruction = builder.store(arguments[2], builder.gep(data, [arguments[1]]))
        instruction.set_metadata("noalias", _scope(builder.module))

    return types.void(array, index, array.dtype), generate


@intrinsic
def bits_of(typing_context, value, shift, mask):
    """float32((value >> shift) & mask) of 32-bit words, for masks below 2**31."""

    def generate(context, builder, signature, arguments):
        word, by, ones = arguments
        return builder.sitofp(builder.and_(builder.lshr(word, by), ones), ir.FloatType())

    return types.float32(types.uint32, types.uint32, types.uint32), generate


@intrinsic
def add_pixels(typing_context, array, index, left, right, first, second, third):
    """Adds left * (first, second, third) to the pixel of four numbers at `index`, right * the same to the next one."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        scalar = arguments[2].type
        wide = ir.VectorType(scalar, 8)
        colour = weight = ir.Constant(wide, [0.0] * 8)
        for lane in range(8):
            at = ir.Constant(ir.IntType(32), lane)
            weight = builder.insert_element(weight, arguments[2 + lane // 4], at)
            if lane % 4 < 3:
                colour = builder.insert_element(colour, arguments[4 + lane % 4], at)
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), wide.as_pointer())
        size = context.get_abi_sizeof(scalar)
        total = builder.fadd(
            builder.load(pointer, align=size), builder.fmul(weight, colour, flags=("contract",)), flags=("contract",)
        )
        builder.store(total, pointer, align=size)

    number = array.dtype
    return types.void(array, index, number, number, number, number, number), generate
