"""The instructions of Intel's AMX that `layers_amx` uses, on other processors: its tile registers lie in memory.

Source of truth: the "Tile" and "AMX" instructions of Intel's manual (Software Developer's Manual, volume 2).
"""

from functools import cache
from importlib import import_module

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.core import cgutils

from hyperplanes.geometry.kernels import compiling, layers_amx

__all__ = ["emulated_kernel"]

ROWS, BYTES = 16, 64
TILE = ROWS * BYTES

_memory = types.CPointer(types.uint8)


@cfunc(types.void(_memory, types.uint8, _memory, types.int64))
def _load(tiles, tile, source, pitch):
    to, given = carray(tiles, 8 * TILE), carray(source, (ROWS - 1) * pitch + BYTES)
    for row in range(ROWS):
        for byte in range(BYTES):
            to[tile * TILE + row * BYTES + byte] = given[row * pitch + byte]


@cfunc(types.void(_memory, types.uint8, _memory, types.int64))
def _store(tiles, tile, target, pitch):
    given, to = carray(tiles, 8 * TILE), carray(target, (ROWS - 1) * pitch + BYTES)
    for row in range(ROWS):
        for byte in range(BYTES):
            to[row * pitch + byte] = given[tile * TILE + row * BYTES + byte]


@cfunc(types.void(_memory, types.uint8, types.uint8, types.uint8))
def _add_products(tiles, total, one, other):
    memory = carray(tiles, 8 * TILE)
    sums = memory[total * TILE : (total + 1) * TILE].view(np.float32)
    # numbers of bfloat16 are the upper halves of single ones
    left = (memory[one * TILE : (one + 1) * TILE].view(np.uint16).astype(np.uint32) << np.uint32(16)).view(np.float32)
    right = (memory[other * TILE : (other + 1) * TILE].view(np.uint16).astype(np.uint32) << np.uint32(16)).view(
        np.float32
    )
    for row in range(ROWS):
        for pair in range(ROWS):
            for column in range(ROWS):
                for half in range(2):
                    product = left[2 * (ROWS * row + pair) + half] * right[2 * (ROWS * pair + column) + half]
                    sums[ROWS * row + column] += product


FUNCTIONS = {"tileloadd64": _load, "tilestored64": _store, "tdpbf16ps": _add_products}


@cache
def emulated_kernel(name):
    """The function of `compile_kernel(name, torch.float32)`; what is compiled is kept nowhere else.

    Args:
        name: "layers_amx.layers" or "layers_amx_bfloat16.layers".
    """
    registers = {}

    def call(builder, name, *arguments):
        if name not in FUNCTIONS:  # nothing is configured or given back
            return
        of_function = builder.function.name
        if of_function not in registers:
            registers[of_function] = cgutils.alloca_once(builder, ir.ArrayType(ir.IntType(8), 8 * TILE))
        numbers = [ir.Constant(ir.IntType(8), each) if isinstance(each, int) else each for each in arguments]
        given = [builder.bitcast(registers[of_function], ir.IntType(8).as_pointer()), *numbers]
        kind = ir.FunctionType(ir.VoidType(), [each.type for each in given])
        place = ir.Constant(ir.IntType(64), FUNCTIONS[name].address)
        builder.call(builder.inttoptr(place, kind.as_pointer()), given)

    original, layers_amx._call = layers_amx._call, call
    try:
        module = import_module(f"hyperplanes.geometry.kernels.{name.removesuffix('.layers')}")
        signature = compiling._SIGNATURES[name].replace("T[", "float32[")
        return njit(f"void({signature})", nogil=True, error_model="numpy", fastmath=compiling.FASTMATH)(module.layers)
    finally:
        layers_amx._call = original
