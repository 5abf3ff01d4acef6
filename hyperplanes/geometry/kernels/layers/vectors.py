"""Vectors and bfloat16 numbers for the kernels of layers (numba only)."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["LANES", "BFloat", "address_of", "read_vector", "rounded", "rounding", "write_vector"]

LANES = 16  # numbers in single precision per AVX-512 vector


class BFloat(ir.Type):
    """LLVM's type bfloat, which llvmlite lacks."""

    def _to_string(self):
        return "bfloat"

    def __eq__(self, other):
        return isinstance(other, BFloat)

    def __hash__(self):
        return hash(BFloat)


def rounded(builder, value):
    """A vector of single precision rounded to bfloat16, as integers of 16 bits."""
    count = value.type.count
    halves = builder.fptrunc(value, ir.VectorType(BFloat(), count))
    return builder.bitcast(halves, ir.VectorType(ir.IntType(16), count))


def address_of(context, builder, kind, array, offset=None):
    """The address of an element of an array, as a pointer to bytes."""
    data = context.make_array(kind)(context, builder, array).data
    place = data if offset is None else builder.gep(data, [offset])
    return builder.bitcast(place, ir.IntType(8).as_pointer())


def read_vector(context, builder, kind, array, at, least=None):
    """LANES numbers of an array from `at` on, at least `least`; NaN stays."""
    floats = ir.VectorType(ir.FloatType(), LANES)
    address = address_of(context, builder, kind, array, at)
    value = builder.load(builder.bitcast(address, floats.as_pointer()), align=4)
    if least is None:
        return value
    least = ir.Constant(floats, [least] * LANES)
    return builder.select(builder.fcmp_ordered("<=", value, least), least, value)


def write_vector(context, builder, kind, array, at, value):
    """Write a vector into an array from `at` on."""
    address = address_of(context, builder, kind, array, at)
    builder.store(value, builder.bitcast(address, value.type.as_pointer()), align=2)


def rounding(least):
    """A function for kernels that raises numbers to at least `least`, if given, and rounds them to bfloat16."""

    @intrinsic
    def round_vector(typing_context, numbers, at, out, place):
        """LANES numbers from `at` on, as bfloat16 from `place` on."""

        def generate(context, builder, signature, arguments):
            value = read_vector(context, builder, signature.args[0], arguments[0], arguments[1], least)
            write_vector(context, builder, signature.args[2], arguments[2], arguments[3], rounded(builder, value))
            return context.get_dummy_value()

        return types.void(numbers, types.int64, out, types.int64), generate

    return round_vector
