"""An emulation of the AMX instructions that `layers.amx` uses, with tile registers in memory, for other processors.

Source of truth: the "Tile" and "AMX" instructions of Intel's manual (Software Developer's Manual, volume 2).
"""

import hashlib
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from llvmlite import binding, ir
from numba import carray, cfunc, njit, types
from numba.core import cgutils, config

from hyperplanes.geometry.kernels import compiling
from hyperplanes.geometry.kernels.layers import amx as layers_amx

__all__ = ["emulated_kernel"]

ROWS, BYTES = 16, 64
TILE = ROWS * BYTES

_memory = types.CPointer(types.uint8)


def _load(tiles, tile, source, pitch):
    to, given = carray(tiles, 8 * TILE), carray(source, (ROWS - 1) * pitch + BYTES)
    for row in range(ROWS):
        for byte in range(BYTES):
            to[tile * TILE + row * BYTES + byte] = given[row * pitch + byte]


def _store(tiles, tile, target, pitch):
    given, to = carray(tiles, 8 * TILE), carray(target, (ROWS - 1) * pitch + BYTES)
    for row in range(ROWS):
        for byte in range(BYTES):
            to[row * pitch + byte] = given[tile * TILE + row * BYTES + byte]


def _add_products(tiles, total, one, other):
    memory = carray(tiles, 8 * TILE)
    sums = memory[total * TILE : (total + 1) * TILE].view(np.float32)
    # a bfloat16 is the upper half of a float32; a word holds two of them, the first one in its lower half
    low, high = np.uint32(16), np.uint32(0xFFFF0000)
    left, right = memory[one * TILE : (one + 1) * TILE].view(np.uint32), memory[other * TILE : (other + 1) * TILE]
    right = right.view(np.uint32)
    lefts = (left << low).view(np.float32), (left & high).view(np.float32)
    rights = (right << low).view(np.float32), (right & high).view(np.float32)
    for row in range(ROWS):
        for pair in range(ROWS):
            for half in range(2):
                factor = lefts[half][ROWS * row + pair]
                for column in range(ROWS):
                    sums[ROWS * row + column] += factor * rights[half][ROWS * pair + column]


_copying = types.void(_memory, types.uint8, _memory, types.int64)
FUNCTIONS = {
    "tileloadd64": (_load, _copying),
    "tilestored64": (_store, _copying),
    "tdpbf16ps": (_add_products, types.void(_memory, types.uint8, types.uint8, types.uint8)),
}


@contextmanager
def _cache_folder():
    """While active, numba's cache folder depends on the sources of the kernels and on this file."""
    name = f"emulated-{hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "CACHE_DIR", str(Path(compiling._cache_folder()) / name))
        yield


@cache
def _instructions():
    """The functions by name, registered as symbols, because addresses are valid in only one process."""
    compiled = {name: cfunc(kind, cache=True)(function) for name, (function, kind) in FUNCTIONS.items()}
    for name, function in compiled.items():
        binding.add_symbol(f"emulated_{name}", function.address)
    return compiled


@cache
def emulated_kernel(name):
    """An emulated `compile_kernel(name, torch.float32)`.

    Args:
        name: "layers.amx.layers" or "layers.amx_bfloat16.layers".
    """
    registers = {}

    def call(builder, name, *arguments):
        if name not in FUNCTIONS:  # configuring and releasing tiles does nothing
            return
        of_function = builder.function.name
        if of_function not in registers:
            registers[of_function] = cgutils.alloca_once(builder, ir.ArrayType(ir.IntType(8), 8 * TILE))
        numbers = [ir.Constant(ir.IntType(8), each) if isinstance(each, int) else each for each in arguments]
        given = [builder.bitcast(registers[of_function], ir.IntType(8).as_pointer()), *numbers]
        kind = ir.FunctionType(ir.VoidType(), [each.type for each in given])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, f"emulated_{name}"), given)

    original, layers_amx._call = layers_amx._call, call
    try:
        module = import_module(f"hyperplanes.geometry.kernels.{name.removesuffix('.layers')}")
        signature = compiling._SIGNATURES[name].replace("T[", "float32[")
        options = {"nogil": True, "error_model": "numpy", "fastmath": compiling.FASTMATH, "cache": True}
        with _cache_folder():
            _instructions()
            return njit(f"void({signature})", **options)(module.layers)
    finally:
        layers_amx._call = original
