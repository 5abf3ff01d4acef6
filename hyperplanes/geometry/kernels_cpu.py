"""The CPU kernels of the fused lookup: loops over points and planes around the block functions.

Every function takes a range of points (or planes) so that threads can share the work; each releases the interpreter
lock. The kernels are compiled on first use, a second or two each, and kept on disk by numba.

Where a point's planes are chosen, the lookups of a chunk of points are first grouped by plane (a counting sort), so
that blocks share a plane there too and only the chosen planes cost anything.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.blocks import (
    BLOCK,
    CHANNELS,
    COLUMN,
    FIRST_RECORD,
    INSIDE,
    PITCH,
    ROW,
    X,
    Y,
    Z,
    fetch_packed,
    fetch_plane,
    inlined,
    inner,
    place,
    project,
)
from hyperplanes.geometry.vector_memory import load, store

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
def scratch(dtype, channels, records):
    """Zeros for the rows of a block and for some records, as laid out in `blocks`."""
    return np.zeros(FIRST_RECORD + PITCH * (3 + channels) * records, dtype)


@inlined
@no_type_check
def take(s, i, points, p):
    """Point p -> lane i."""
    s[X + i] = points[p, 0]
    s[Y + i] = points[p, 1]
    s[Z + i] = points[p, 2]


@inner
@no_type_check
def _look(s, record, view, matrices, images, packed, bits, height, width, background, nearest):
    project(s, matrices, view, nearest)
    place(s, record, height, width)
    size, channels = height * width, images.shape[1]
    if bits:
        fetch_packed(s, record, packed, view * size, height, width, bits, background)
    else:
        for c in range(channels):
            fetch_plane(s, record, images, (view * channels + c) * size, height, width, c, background)


@inlined
@no_type_check
def _write(s, first, count, planes, channels, colours, coordinates, valid):
    """All records of a block -> the flat outputs from point `first` on, one output at a time: streams of writes."""
    step = (3 + channels) * PITCH
    for i in range(count):
        k = (first + i) * planes * channels
        for view in range(planes):
            row = FIRST_RECORD + view * step + CHANNELS + i
            if channels == 3:
                store(colours, k, load(s, row))
                store(colours, k + 1, load(s, row + PITCH))
                store(colours, k + 2, load(s, row + 2 * PITCH))
            else:
                for c in range(channels):
                    store(colours, k + c, load(s, row + c * PITCH))
            k += channels
    for i in range(count):
        k = (first + i) * planes
        for view in range(planes):
            row = FIRST_RECORD + view * step + i
            store(coordinates, 2 * (k + view), load(s, row + COLUMN))
            store(coordinates, 2 * (k + view) + 1, load(s, row + ROW))
    for i in range(count):
        k = (first + i) * planes
        for view in range(planes):
            store(valid, k + view, np.uint8(load(s, FIRST_RECORD + view * step + INSIDE + i)))


@no_type_check
def forward(points, matrices, images, packed, bits, height, width, background, nearest,
            colours, coordinates, valid, start, stop):  # fmt: skip
    """Looks points start..stop up in all planes."""
    planes, channels = images.shape[0], images.shape[1]
    s = scratch(points.dtype, channels, planes)
    step = (3 + channels) * PITCH
    for p in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p)
        for i in range(count):
            take(s, i, points, p + i)
        for view in range(planes):
            record = FIRST_RECORD + view * step
            _look(s, record, view, matrices, images, packed, bits, height, width, background, nearest)
        _write(s, p, count, planes, channels, colours, coordinates, valid)


@no_type_check
def forward_chosen(points, views, matrices, images, packed, bits, height, width, background, nearest,
                   colours, coordinates, valid, start, stop):  # fmt: skip
    """Looks points start..stop up in the planes chosen for each."""
    planes, channels, m = images.shape[0], images.shape[1], views.shape[1]
    s = scratch(points.dtype, channels, 1)
    first = np.empty(planes + 1, np.int64)
    order = np.empty((stop - start) * m, np.int64)
    grouped(views, start, stop, planes, first, order)
    for view in range(planes):
        for begin in range(first[view], first[view + 1], BLOCK):
            count = min(BLOCK, first[view + 1] - begin)
            for i in range(count):
                take(s, i, points, order[begin + i] // m)
            _look(s, FIRST_RECORD, view, matrices, images, packed, bits, height, width, background, nearest)
            for i in range(count):
                k, row = order[begin + i], FIRST_RECORD + i
                store(coordinates, 2 * k, load(s, row + COLUMN))
                store(coordinates, 2 * k + 1, load(s, row + ROW))
                store(valid, k, np.uint8(load(s, row + INSIDE)))
                for c in range(channels):
                    store(colours, k * channels + c, load(s, row + CHANNELS + c * PITCH))
