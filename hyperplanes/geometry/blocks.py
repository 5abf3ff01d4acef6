"""The fused lookup on one block of points and one plane, as numba functions that LLVM vectorises over the block.

A block is BLOCK lookups that share a view. Its numbers live in one scratch array, one row of BLOCK values a quantity
(the constants below), small enough for the first-level cache. All functions work in the dtype of the scratch.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from hyperplanes.geometry.vector_memory import bits_of, load, read, store

__all__ = [
    "BLOCK",
    "CHANNELS",
    "back_project",
    "fetch_packed",
    "fetch_plane",
    "inlined",
    "inner",
    "place",
    "project",
    "pull_packed",
    "pull_plane",
    "start_pull",
]  # fmt: skip

BLOCK = 128
# Rows of the scratch: a point, where points do not come as rows; its pixel before and after clamping; 1 / depth,
# zero behind the camera; whether it is inside the image; the gradients with respect to the pixel and to the point;
# coordinates in [-1, 1], or going back the gradients with respect to them; the same for the channels, one row each.
X, Y, Z, RAW_U, RAW_V, RECIPROCAL, U, V, INSIDE, GRAD_U, GRAD_V, GRAD_X, GRAD_Y, GRAD_Z, COLUMN, ROW, CHANNELS = (
    BLOCK * row for row in range(17)
)

# Everything of fast maths but the assumption that there are no NaN and no infinities. What runs once a lookup is
# forced inline; LLVM calls it otherwise, which costs more than its work.
inner = njit(fastmath={"contract", "reassoc", "arcp", "nsz"}, error_model="numpy", nogil=True)
inlined = njit(fastmath={"contract", "reassoc", "arcp", "nsz"}, error_model="numpy", nogil=True, forceinline=True)


@inner
@no_type_check
def project(s, points, at, pitch, matrices, view, nearest):
    """Points -> RAW_U, RAW_V, RECIPROCAL by the view's 3 x 4 matrix.

    The coordinates x, y, z lie in `points` from `at` on, `pitch` apart.
    """
    one, zero = s.dtype.type(1), s.dtype.type(0)
    m00, m01, m02, m03 = matrices[view, 0, 0], matrices[view, 0, 1], matrices[view, 0, 2], matrices[view, 0, 3]
    m10, m11, m12, m13 = matrices[view, 1, 0], matrices[view, 1, 1], matrices[view, 1, 2], matrices[view, 1, 3]
    m20, m21, m22, m23 = matrices[view, 2, 0], matrices[view, 2, 1], matrices[view, 2, 2], matrices[view, 2, 3]
    for i in range(BLOCK):
        x, y, z = load(points, at + i), load(points, at + pitch + i), load(points, at + 2 * pitch + i)
        depth = m20 * x + m21 * y + m22 * z + m23
        front = depth > nearest
        reciprocal = one / (depth if front else one)
        store(s, RAW_U + i, (m00 * x + m01 * y + m02 * z + m03) * reciprocal)
        store(s, RAW_V + i, (m10 * x + m11 * y + m12 * z + m13) * reciprocal)
        store(s, RECIPROCAL + i, reciprocal if front else zero)


@inner
@no_type_check
def place(s, out, column, row, height, width):
    """RAW_U, RAW_V, RECIPROCAL -> clamped U, V; INSIDE; coordinates, into `out` at `column` and `row`.

    Comparisons are written so that NaN falls to 0.
    """
    one, zero = s.dtype.type(1), s.dtype.type(0)
    right, bottom = s.dtype.type(width - 1), s.dtype.type(height - 1)
    per_column = s.dtype.type(2) / s.dtype.type(max(width - 1, 1))
    per_row = s.dtype.type(2) / s.dtype.type(max(height - 1, 1))
    for i in range(BLOCK):
        u, v = load(s, RAW_U + i), load(s, RAW_V + i)
        front = load(s, RECIPROCAL + i) > zero
        inside = front & (u >= zero) & (u <= right) & (v >= zero) & (v <= bottom)
        u = u if u > zero else zero
        u = u if u < right else right
        v = v if v > zero else zero
        v = v if v < bottom else bottom
        store(s, U + i, u)
        store(s, V + i, v)
        store(s, INSIDE + i, one if inside else zero)
        store(out, column + i, u * per_column - one if front else zero)
        store(out, row + i, v * per_row - one if front else zero)


@inner
@no_type_check
def fetch_plane(s, out, first, images, offset, height, width, background):
    """U, V, INSIDE -> bilinear values of the float plane that starts at `offset`, into `out` from `first` on."""
    last_x, last_y = np.int32(max(width - 2, 0)), np.int32(max(height - 2, 0))
    right, below = np.int32(1 if width > 1 else 0), np.int32(width if height > 1 else 0)
    stride, diagonal, zero = np.int32(width), np.int32(right + below), s.dtype.type(0)
    for i in range(BLOCK):
        u, v = load(s, U + i), load(s, V + i)
        x, y = min(np.int32(u), last_x), min(np.int32(v), last_y)
        fx, fy = u - s.dtype.type(x), v - s.dtype.type(y)
        k = np.int32(y * stride + x)
        a, b = read(images, offset, k), read(images, offset, np.int32(k + right))
        c, d = read(images, offset, np.int32(k + below)), read(images, offset, np.int32(k + diagonal))
        top = a + fx * (b - a)
        value = top + fy * (c + fx * (d - c) - top)
        store(out, first + i, value if load(s, INSIDE + i) > zero else background)


@inner
@no_type_check
def _format(bits):
    """(shifts of the channels, mask, mask of the last channel) of three channels in 32 bits."""
    narrow = bits if bits == 8 else bits - 1
    return np.uint32(0), np.uint32(bits), np.uint32(2 * bits), np.uint32((1 << bits) - 1), np.uint32((1 << narrow) - 1)


@inner
@no_type_check
def fetch_packed(s, out, first, pitch, packed, offset, height, width, bits, background):
    """As `fetch_plane`, for three channels packed into 32 bits: (8, 8, 8) or (11, 11, 10), first channel lowest.

    The channels' values go `pitch` apart.
    """
    last_x, last_y = np.int32(max(width - 2, 0)), np.int32(max(height - 2, 0))
    right, below = np.int32(1 if width > 1 else 0), np.int32(width if height > 1 else 0)
    stride, diagonal, zero, one = np.int32(width), np.int32(right + below), s.dtype.type(0), s.dtype.type(1)
    low, shift, twice, mask, mask_last = _format(bits)
    unit, unit_last = one / s.dtype.type(mask), one / s.dtype.type(mask_last)
    for i in range(BLOCK):
        u, v = load(s, U + i), load(s, V + i)
        x, y = min(np.int32(u), last_x), min(np.int32(v), last_y)
        fx, fy = u - s.dtype.type(x), v - s.dtype.type(y)
        k = np.int32(y * stride + x)
        a, b = read(packed, offset, k), read(packed, offset, np.int32(k + right))
        c, d = read(packed, offset, np.int32(k + below)), read(packed, offset, np.int32(k + diagonal))
        wd = fx * fy
        wb, wc = fx - wd, fy - wd
        wa = one - fx - wc
        inside = load(s, INSIDE + i) > zero
        red = wa * bits_of(a, low, mask) + wb * bits_of(b, low, mask)
        red += wc * bits_of(c, low, mask) + wd * bits_of(d, low, mask)
        green = wa * bits_of(a, shift, mask) + wb * bits_of(b, shift, mask)
        green += wc * bits_of(c, shift, mask) + wd * bits_of(d, shift, mask)
        blue = wa * bits_of(a, twice, mask_last) + wb * bits_of(b, twice, mask_last)
        blue += wc * bits_of(c, twice, mask_last) + wd * bits_of(d, twice, mask_last)
        store(out, first + i, red * unit if inside else background)
        store(out, first + pitch + i, green * unit if inside else background)
        store(out, first + 2 * pitch + i, blue * unit_last if inside else background)


@inner
@no_type_check
def pull_plane(s, images, offset, height, width, channel):
    """Adds one channel's part to GRAD_U, GRAD_V: its gradient times the slope of its plane."""
    last_x, last_y = np.int32(max(width - 2, 0)), np.int32(max(height - 2, 0))
    right, below = np.int32(1 if width > 1 else 0), np.int32(width if height > 1 else 0)
    stride, diagonal = np.int32(width), np.int32(right + below)
    for i in range(BLOCK):
        u, v = load(s, U + i), load(s, V + i)
        x, y = min(np.int32(u), last_x), min(np.int32(v), last_y)
        fx, fy = u - s.dtype.type(x), v - s.dtype.type(y)
        k = np.int32(y * stride + x)
        a, b = read(images, offset, k), read(images, offset, np.int32(k + right))
        c, d = read(images, offset, np.int32(k + below)), read(images, offset, np.int32(k + diagonal))
        gradient = load(s, CHANNELS + channel * BLOCK + i) * load(s, INSIDE + i)
        twist = (d - c) - (b - a)
        store(s, GRAD_U + i, load(s, GRAD_U + i) + gradient * ((b - a) + fy * twist))
        store(s, GRAD_V + i, load(s, GRAD_V + i) + gradient * ((c - a) + fx * twist))


@inner
@no_type_check
def pull_packed(s, packed, offset, height, width, bits):
    """As `pull_plane`, for all three channels of packed images."""
    last_x, last_y = np.int32(max(width - 2, 0)), np.int32(max(height - 2, 0))
    right, below = np.int32(1 if width > 1 else 0), np.int32(width if height > 1 else 0)
    stride, diagonal, one = np.int32(width), np.int32(right + below), s.dtype.type(1)
    low, shift, twice, mask, mask_last = _format(bits)
    unit, unit_last = one / s.dtype.type(mask), one / s.dtype.type(mask_last)
    for i in range(BLOCK):
        u, v = load(s, U + i), load(s, V + i)
        x, y = min(np.int32(u), last_x), min(np.int32(v), last_y)
        fx, fy = u - s.dtype.type(x), v - s.dtype.type(y)
        k = np.int32(y * stride + x)
        a, b = read(packed, offset, k), read(packed, offset, np.int32(k + right))
        c, d = read(packed, offset, np.int32(k + below)), read(packed, offset, np.int32(k + diagonal))
        inside = load(s, INSIDE + i)
        first = load(s, CHANNELS + i) * inside * unit
        second = load(s, CHANNELS + BLOCK + i) * inside * unit
        third = load(s, CHANNELS + 2 * BLOCK + i) * inside * unit_last
        # The gradient with respect to a tap is the same sum for each: contract channels first, then interpolate.
        ga = first * bits_of(a, low, mask) + second * bits_of(a, shift, mask)
        ga += third * bits_of(a, twice, mask_last)
        gb = first * bits_of(b, low, mask) + second * bits_of(b, shift, mask)
        gb += third * bits_of(b, twice, mask_last)
        gc = first * bits_of(c, low, mask) + second * bits_of(c, shift, mask)
        gc += third * bits_of(c, twice, mask_last)
        gd = first * bits_of(d, low, mask) + second * bits_of(d, shift, mask)
        gd += third * bits_of(d, twice, mask_last)
        twist = (gd - gc) - (gb - ga)
        store(s, GRAD_U + i, load(s, GRAD_U + i) + (gb - ga) + fy * twist)
        store(s, GRAD_V + i, load(s, GRAD_V + i) + (gc - ga) + fx * twist)


@inner
@no_type_check
def start_pull(s, height, width):
    """GRAD_U, GRAD_V from the gradient of the coordinates in COLUMN, ROW; none passes where they were clamped."""
    zero = s.dtype.type(0)
    right, bottom = s.dtype.type(width - 1), s.dtype.type(height - 1)
    per_column = s.dtype.type(2) / s.dtype.type(max(width - 1, 1))
    per_row = s.dtype.type(2) / s.dtype.type(max(height - 1, 1))
    for i in range(BLOCK):
        u, v = load(s, RAW_U + i), load(s, RAW_V + i)
        front = load(s, RECIPROCAL + i) > zero
        free_u = front & (u >= zero) & (u <= right)
        free_v = front & (v >= zero) & (v <= bottom)
        store(s, GRAD_U + i, load(s, COLUMN + i) * per_column if free_u else zero)
        store(s, GRAD_V + i, load(s, ROW + i) * per_row if free_v else zero)


@inner
@no_type_check
def back_project(s, points, at, pitch, matrices, view, gradients, into, sums):
    """GRAD_U, GRAD_V -> added to `gradients` of points, from `into` on, and to the view's row of `sums`.

    With h = M (x, 1) and (u, v) = (h0, h1) / h2: dL/dh = (g_u, g_v, -(g_u u + g_v v)) / h2.
    """
    m00, m01, m02 = matrices[view, 0, 0], matrices[view, 0, 1], matrices[view, 0, 2]
    m10, m11, m12 = matrices[view, 1, 0], matrices[view, 1, 1], matrices[view, 1, 2]
    m20, m21, m22 = matrices[view, 2, 0], matrices[view, 2, 1], matrices[view, 2, 2]
    zero = s.dtype.type(0)
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = s20 = s21 = s22 = s23 = zero
    for i in range(BLOCK):
        x, y, z = load(points, at + i), load(points, at + pitch + i), load(points, at + 2 * pitch + i)
        reciprocal = load(s, RECIPROCAL + i)
        h0, h1 = load(s, GRAD_U + i) * reciprocal, load(s, GRAD_V + i) * reciprocal
        # Behind the camera RAW_U may be anything, but h0 is zero there only if it is finite.
        raw_u = load(s, RAW_U + i) if reciprocal > zero else zero
        raw_v = load(s, RAW_V + i) if reciprocal > zero else zero
        h2 = -(h0 * raw_u + h1 * raw_v)
        store(gradients, into + i, load(gradients, into + i) + m00 * h0 + m10 * h1 + m20 * h2)
        store(gradients, into + pitch + i, load(gradients, into + pitch + i) + m01 * h0 + m11 * h1 + m21 * h2)
        store(gradients, into + 2 * pitch + i, load(gradients, into + 2 * pitch + i) + m02 * h0 + m12 * h1 + m22 * h2)
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
