"""The CPU kernels of the fused lookup: loops over points and planes around the block functions.

Every function takes a range of points (or planes) so that threads can share the work; each releases the interpreter
lock. The kernels are compiled on first use, a second or two each, and kept on disk by numba.

Points are rows of x, y and z, and results are planar in memory, (view, channel, point), so that a block is read and
written as whole vectors. All rows are `pitch` long, a multiple of BLOCK. One plane after the other is looked at for a
whole chunk of points: its pixels then stay in the cache, interleaved first where the chunk is large enough.

Where a point's planes are chosen, the lookups of a chunk of points are first grouped by plane (a counting sort), so
that blocks share a plane there too and only the chosen planes cost anything.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.blocks import (
    BLOCK,
    CHANNELS,
    COLUMN,
    INSIDE,
    ROW,
    X,
    Y,
    Z,
    inlined,
    inner,
    place,
    project,
)
from hyperplanes.geometry.kernels.interpolation import fetch_packed, fetch_pixels, fetch_plane, interleave, room
from hyperplanes.geometry.kernels.llvm import load, store

__all__ = ["forward", "forward_chosen", "grouped", "scratch", "take"]


@inner
@no_type_check
def grouped(views, start, stop, planes, first, order):
    """Counting sort of the lookups of points start..stop by plane: `order` holds flat indices point * m + slot."""
    m = views.shape[1]
    first[:] = 0
    for p in range(start, stop):
        for j in range(m):
            first[views[p, j] + 1] += 1
    for v in range(planes):
        first[v + 1] += first[v]
    for p in range(start, stop):
        for j in range(m):
            v = views[p, j]
            order[first[v]] = p * m + j
            first[v] += 1
    for v in range(planes, 0, -1):
        first[v] = first[v - 1]
    first[0] = 0


@inner
@no_type_check
def scratch(dtype, channels):
    """Zeros for the rows of a block, as laid out in `blocks`."""
    return np.zeros(CHANNELS + BLOCK * channels, dtype)


@inlined
@no_type_check
def take(s, i, points, pitch, p):
    """Point p -> lane i."""
    s[X + i] = points[p]
    s[Y + i] = points[pitch + p]
    s[Z + i] = points[2 * pitch + p]


@no_type_check
def forward(points, pitch, matrices, images, packed, bits, height, width, background, nearest,
            colours, coordinates, valid, start, stop):  # fmt: skip
    """Looks points start..stop up in all planes."""
    planes, channels = images.shape[0], images.shape[1]
    s, pixels = scratch(points.dtype, 0), room(images, bits, stop - start if planes > 1 else 0)
    size = height * width
    for view in range(planes):
        if len(pixels):
            interleave(images, view, pixels)
        for p in range(start, stop, BLOCK):
            project(s, points, p, pitch, matrices, view, nearest)
            k = 2 * view * pitch + p
            place(s, coordinates, k, k + pitch, height, width)
            k = view * pitch + p
            for i in range(BLOCK):
                store(valid, k + i, np.uint8(load(s, INSIDE + i)))
            k = channels * view * pitch + p
            if bits:
                fetch_packed(s, colours, k, pitch, packed, view * size, height, width, bits, background)
            elif len(pixels):
                fetch_pixels(s, colours, k, pitch, pixels, height, width, background)
            else:
                for c in range(channels):
                    offset = (view * channels + c) * size
                    fetch_plane(s, colours, k + c * pitch, images, offset, height, width, background)


@no_type_check
def forward_chosen(points, pitch, views, matrices, images, packed, bits, height, width, background, nearest,
                   colours, coordinates, valid, start, stop):  # fmt: skip
    """Looks points start..stop up in the planes chosen for each."""
    planes, channels, m = images.shape[0], images.shape[1], views.shape[1]
    s = scratch(points.dtype, channels)
    size = height * width
    first = np.empty(planes + 1, np.int64)
    order = np.empty((stop - start) * m, np.int64)
    grouped(views, start, stop, planes, first, order)
    for view in range(planes):
        for begin in range(first[view], first[view + 1], BLOCK):
            count = min(BLOCK, first[view + 1] - begin)
            for i in range(count):
                take(s, i, points, pitch, order[begin + i] // m)
            project(s, s, X, BLOCK, matrices, view, nearest)
            place(s, s, COLUMN, ROW, height, width)
            if bits:
                fetch_packed(s, s, CHANNELS, BLOCK, packed, view * size, height, width, bits, background)
            else:
                for c in range(channels):
                    offset = (view * channels + c) * size
                    fetch_plane(s, s, CHANNELS + c * BLOCK, images, offset, height, width, background)
            for i in range(count):
                p, j = order[begin + i] // m, order[begin + i] % m
                store(coordinates, 2 * j * pitch + p, load(s, COLUMN + i))
                store(coordinates, (2 * j + 1) * pitch + p, load(s, ROW + i))
                store(valid, j * pitch + p, np.uint8(load(s, INSIDE + i)))
                for c in range(channels):
                    store(colours, (j * channels + c) * pitch + p, load(s, CHANNELS + c * BLOCK + i))
