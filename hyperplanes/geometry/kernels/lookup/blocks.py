"""Projection of a block of points onto one plane, and its gradient, as numba functions vectorised over the block.

A block is BLOCK points on one plane. Its numbers lie in one scratch array, one row of BLOCK values a quantity (the
constants below), small enough for the first-level cache. All functions compute in the dtype of the scratch. The plane
is read in `interpolation`.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from hyperplanes.geometry.kernels.compiling import FASTMATH
from hyperplanes.geometry.kernels.llvm import load, read, store
from hyperplanes.geometry.kernels.memory import BLOCK
from hyperplanes.geometry.lookup_torch import BORDER_TOLERANCE

__all__ = [
    "BLOCK",
    "CHANNELS",
    "back_project",
    "blended",
    "copy",
    "inlined",
    "place",
    "project",
    "scratch",
    "start_gradient",
    "unnormalize",
]

# Rows of the scratch: pixel before clamping; 1 / z, zero behind the camera; clamped pixel; whether it is inside the
# image; gradients with respect to the pixel; coordinates in [-1, 1], or in the backward pass their gradients; the upper
# left one of the four pixels to interpolate, and the fractions of a pixel beyond it.
RAW_U, RAW_V, RECIPROCAL, U, V, INSIDE, GRAD_U, GRAD_V, COLUMN, ROW, CORNER, ACROSS, DOWN = (
    BLOCK * row for row in range(13)
)
# Two rows of four numbers a point; three channels' slopes across and down; the channels, one row each.
TILE, SLOPES, CHANNELS = BLOCK * 13, BLOCK * 21, BLOCK * 27

# Everything that a kernel calls is inlined into it. A function of one point takes less time than its call; and what
# numba does not inline becomes a weak symbol, which the loader resolves to the copy of whichever kernel was compiled or
# loaded first: the last bit of a result would then depend on what ran before.
inlined = njit(fastmath=FASTMATH, error_model="numpy", nogil=True, forceinline=True)
# Products and sums are fused as written and not reordered: planes and interleaved pixels give the same bits.
blended = njit(fastmath={"contract"}, error_model="numpy", nogil=True, forceinline=True)


@inlined
@no_type_check
def scratch(dtype, channels):
    """The scratch of a block."""
    return np.zeros(CHANNELS + BLOCK * channels, dtype)


@inlined
@no_type_check
def project(s, points, at, pitch, matrices, view, min_z):
    """Points -> RAW_U, RAW_V, RECIPROCAL by the view's 3 x 4 matrix.

    The coordinates x, y, z lie in `points` from `at` on, `pitch` apart.
    """
    one, zero = s.dtype.type(1), s.dtype.type(0)
    m00, m01, m02, m03 = matrices[view, 0, 0], matrices[view, 0, 1], matrices[view, 0, 2], matrices[view, 0, 3]
    m10, m11, m12, m13 = matrices[view, 1, 0], matrices[view, 1, 1], matrices[view, 1, 2], matrices[view, 1, 3]
    m20, m21, m22, m23 = matrices[view, 2, 0], matrices[view, 2, 1], matrices[view, 2, 2], matrices[view, 2, 3]
    for i in range(BLOCK):
        x, y, z = load(points, at + i), load(points, at + pitch + i), load(points, at + 2 * pitch + i)
        camera_z = m20 * x + m21 * y + m22 * z + m23
        front = camera_z > min_z
        reciprocal = one / (camera_z if front else one)
        store(s, RAW_U + i, (m00 * x + m01 * y + m02 * z + m03) * reciprocal)
        store(s, RAW_V + i, (m10 * x + m11 * y + m12 * z + m13) * reciprocal)
        store(s, RECIPROCAL + i, reciprocal if front else zero)


@inlined
@no_type_check
def _clamped(value, last):
    """A coordinate between 0 and `last`; the comparisons are written so that NaN becomes 0."""
    zero = type(value)(0)
    value = value if value > zero else zero
    return value if value < last else last


@inlined
@no_type_check
def place(s, out, column, row, height, width):
    """RAW_U, RAW_V, RECIPROCAL -> clamped U, V; INSIDE; coordinates, into `out` at `column` and `row`."""
    one, zero, border = s.dtype.type(1), s.dtype.type(0), s.dtype.type(BORDER_TOLERANCE)
    right, bottom = s.dtype.type(width - 1), s.dtype.type(height - 1)
    per_column = s.dtype.type(2) / s.dtype.type(max(width - 1, 1))
    per_row = s.dtype.type(2) / s.dtype.type(max(height - 1, 1))
    for i in range(BLOCK):
        u, v = load(s, RAW_U + i), load(s, RAW_V + i)
        front = load(s, RECIPROCAL + i) > zero
        inside = front & (u >= -border) & (u <= right + border) & (v >= -border) & (v <= bottom + border)
        u, v = _clamped(u, right), _clamped(v, bottom)
        store(s, U + i, u)
        store(s, V + i, v)
        store(s, INSIDE + i, one if inside else zero)
        store(out, column + i, u * per_column - one if front else zero)
        store(out, row + i, v * per_row - one if front else zero)


@inlined
@no_type_check
def copy(s, row, count, values, at, stride):
    """Every `stride`-th of `count` numbers -> a row of the scratch, zeros after them; whole vectors where adjacent."""
    if stride == 1 and count == BLOCK:
        for i in range(BLOCK):
            store(s, row + i, read(values, at, i))
    else:
        for i in range(count):
            store(s, row + i, read(values, at, i * stride))
        for i in range(count, BLOCK):
            store(s, row + i, s.dtype.type(0))


@inlined
@no_type_check
def _unnormalize(s, count, values, at, step, apart, height, width):
    one, zero = s.dtype.type(1), s.dtype.type(0)
    right, bottom = s.dtype.type(width - 1), s.dtype.type(height - 1)
    per_column, per_row = s.dtype.type(0.5) * right, s.dtype.type(0.5) * bottom
    for i in range(count):
        u = (read(values, at, i * step) + one) * per_column
        v = (read(values, at, i * step + apart) + one) * per_row
        inside = (u >= zero) & (u <= right) & (v >= zero) & (v <= bottom)
        u, v = _clamped(u, right), _clamped(v, bottom)
        store(s, U + i, u)
        store(s, V + i, v)
        store(s, INSIDE + i, one if inside else zero)


@inlined
@no_type_check
def unnormalize(s, count, values, at, by, height, width):
    """Coordinates in [-1, 1] from `at` on, `by` (point, view, axis) apart -> clamped U, V; INSIDE.

    Lanes without a point keep their values. Comparisons are written so that NaN becomes 0.
    """
    if by[0] == 2 and by[2] == 1 and count == BLOCK:  # pairs of adjacent numbers: strides known to the compiler
        _unnormalize(s, BLOCK, values, at, 2, 1, height, width)
    else:
        _unnormalize(s, count, values, at, by[0], by[2], height, width)


@inlined
@no_type_check
def start_gradient(s, height, width):
    """Gradients of coordinates in COLUMN, ROW -> GRAD_U, GRAD_V."""
    per_column = s.dtype.type(2) / s.dtype.type(max(width - 1, 1))
    per_row = s.dtype.type(2) / s.dtype.type(max(height - 1, 1))
    for i in range(BLOCK):
        store(s, GRAD_U + i, load(s, COLUMN + i) * per_column)
        store(s, GRAD_V + i, load(s, ROW + i) * per_row)


@inlined
@no_type_check
def back_project(s, points, at, pitch, matrices, view, gradients, sums):
    """GRAD_U, GRAD_V -> added to the `gradients` of points, laid out like these, and to the view's row of `sums`.

    What was clamped has no gradient. With h = M (x, 1) and (u, v) = (h0, h1) / h2:
    dL/dh = (g_u, g_v, -(g_u u + g_v v)) / h2.
    """
    m00, m01, m02 = matrices[view, 0, 0], matrices[view, 0, 1], matrices[view, 0, 2]
    m10, m11, m12 = matrices[view, 1, 0], matrices[view, 1, 1], matrices[view, 1, 2]
    m20, m21, m22 = matrices[view, 2, 0], matrices[view, 2, 1], matrices[view, 2, 2]
    zero = s.dtype.type(0)
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = s20 = s21 = s22 = s23 = zero
    for i in range(BLOCK):
        x, y, z = load(points, at + i), load(points, at + pitch + i), load(points, at + 2 * pitch + i)
        reciprocal = load(s, RECIPROCAL + i)
        # Clamped pixels differ from unclamped ones, also where these are NaN, and are always finite.
        u, v, front = load(s, U + i), load(s, V + i), reciprocal > zero
        h0 = load(s, GRAD_U + i) * reciprocal if front & (load(s, RAW_U + i) == u) else zero
        h1 = load(s, GRAD_V + i) * reciprocal if front & (load(s, RAW_V + i) == v) else zero
        h2 = -(h0 * u + h1 * v)
        store(gradients, at + i, load(gradients, at + i) + m00 * h0 + m10 * h1 + m20 * h2)
        store(gradients, at + pitch + i, load(gradients, at + pitch + i) + m01 * h0 + m11 * h1 + m21 * h2)
        store(gradients, at + 2 * pitch + i, load(gradients, at + 2 * pitch + i) + m02 * h0 + m12 * h1 + m22 * h2)
        s00 += h0 * x
        s01 += h0 * y
        s02 += h0 * z
        s03 += h0
        s10 += h1 * x
        s11 += h1 * y
        s12 += h1 * z
        s13 += h1
        s20 += h2 * x
        s21 += h2 * y
        s22 += h2 * z
        s23 += h2
    for k, value in enumerate((s00, s01, s02, s03, s10, s11, s12, s13, s20, s21, s22, s23)):
        sums[view, k] += value
