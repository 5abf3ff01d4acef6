"""The CPU kernels of the fused lookup: loops over points and planes around the block functions.

Every function takes a range of points (or planes) so that threads can share the work; each releases the interpreter
lock. The kernels are compiled on first use, a second or two each, and kept on disk by numba.

Where a point's planes are chosen, the lookups of a chunk of points are first grouped by plane (a counting sort), so
that blocks share a plane there too and only the chosen planes cost anything.
"""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import no_type_check

import numba
import numpy as np
from numba import njit

from hyperplanes.geometry.blocks import (
    BLOCK,
    COLUMN,
    FIRST_CHANNEL,
    GRAD_X,
    GRAD_Y,
    GRAD_Z,
    INSIDE,
    ROW,
    U,
    V,
    X,
    Y,
    Z,
    back_project,
    fetch_packed,
    fetch_plane,
    inner,
    place,
    project,
    pull_packed,
    pull_plane,
    start_pull,
)
from hyperplanes.geometry.vector_memory import load, store

__all__ = ["compiled"]


@inner
@no_type_check
def _grouped(views, start, stop, planes, first, order):
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
def _look(s, view, matrices, images, packed, bits, height, width, background, nearest):
    project(s, matrices, view, nearest)
    place(s, height, width)
    size, channels = height * width, images.shape[1]
    if bits:
        fetch_packed(s, packed, view * size, height, width, bits, background)
    else:
        for c in range(channels):
            offset = (view * channels + c) * size
            fetch_plane(s, images, offset, height, width, FIRST_CHANNEL + c * BLOCK, background)


@inner
@no_type_check
def _write(s, i, k, channels, colours, coordinates, valid):
    """Lane i of the block -> lookup k of the flat outputs."""
    q = k * 2
    store(coordinates, q, load(s, COLUMN + i))
    store(coordinates, q + 1, load(s, ROW + i))
    store(valid, k, np.uint8(load(s, INSIDE + i)))
    q = k * channels
    if channels == 3:
        store(colours, q, load(s, FIRST_CHANNEL + i))
        store(colours, q + 1, load(s, FIRST_CHANNEL + BLOCK + i))
        store(colours, q + 2, load(s, FIRST_CHANNEL + 2 * BLOCK + i))
    else:
        for c in range(channels):
            store(colours, q + c, load(s, FIRST_CHANNEL + c * BLOCK + i))


@inner
@no_type_check
def _take(s, i, points, p):
    s[X + i] = points[p, 0]
    s[Y + i] = points[p, 1]
    s[Z + i] = points[p, 2]


@no_type_check
def forward(points, matrices, images, packed, bits, height, width, background, nearest,
            colours, coordinates, valid, start, stop):  # fmt: skip
    """Looks points start..stop up in all planes."""
    planes, channels = images.shape[0], images.shape[1]
    s = np.zeros(FIRST_CHANNEL + BLOCK * images.shape[1], points.dtype)
    for p in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p)
        for i in range(count):
            _take(s, i, points, p + i)
        for view in range(planes):
            _look(s, view, matrices, images, packed, bits, height, width, background, nearest)
            for i in range(count):
                k = (p + i) * planes + view
                _write(s, i, k, channels, colours, coordinates, valid)


@no_type_check
def forward_chosen(points, views, matrices, images, packed, bits, height, width, background, nearest,
                   colours, coordinates, valid, start, stop):  # fmt: skip
    """Looks points start..stop up in the planes chosen for each."""
    channels = images.shape[1]
    s = np.zeros(FIRST_CHANNEL + BLOCK * images.shape[1], points.dtype)
    planes, m = matrices.shape[0], views.shape[1]
    first = np.empty(planes + 1, np.int64)
    order = np.empty((stop - start) * m, np.int64)
    _grouped(views, start, stop, planes, first, order)
    for view in range(planes):
        for k in range(first[view], first[view + 1], BLOCK):
            count = min(BLOCK, first[view + 1] - k)
            for i in range(count):
                _take(s, i, points, order[k + i] // m)
            _look(s, view, matrices, images, packed, bits, height, width, background, nearest)
            for i in range(count):
                _write(s, i, order[k + i], channels, colours, coordinates, valid)


@inner
@no_type_check
def _read_gradient(s, i, p, j, grad_colours, grad_coordinates):
    s[COLUMN + i] = grad_coordinates[p, j, 0]
    s[ROW + i] = grad_coordinates[p, j, 1]
    for c in range(grad_colours.shape[2]):
        s[FIRST_CHANNEL + c * BLOCK + i] = grad_colours[p, j, c]


@inner
@no_type_check
def _clear_gradient(s, start, channels):
    """Zeros for the lanes of a block that hold no lookup."""
    for i in range(start, BLOCK):
        s[COLUMN + i] = 0
        s[ROW + i] = 0
        for c in range(channels):
            s[FIRST_CHANNEL + c * BLOCK + i] = 0


@inner
@no_type_check
def _pull(s, view, matrices, images, packed, bits, height, width, sums):
    """The gradient in COLUMN, ROW and the channel rows -> GRAD_X, GRAD_Y, GRAD_Z and the matrix sums."""
    start_pull(s, height, width)
    size, channels = height * width, images.shape[1]
    if bits:
        pull_packed(s, packed, view * size, height, width, bits)
    else:
        for c in range(channels):
            offset = (view * channels + c) * size
            pull_plane(s, images, offset, height, width, FIRST_CHANNEL + c * BLOCK)
    back_project(s, matrices, view, sums)


@no_type_check
def backward(points, matrices, images, packed, bits, height, width, nearest, grad_colours, grad_coordinates,
             grad_points, sums, start, stop):  # fmt: skip
    """Gradients with respect to points start..stop, and their share of the matrices' gradient, added to `sums`."""
    channels = images.shape[1]
    s = np.zeros(FIRST_CHANNEL + BLOCK * channels, points.dtype)
    for p in range(start, stop, BLOCK):
        count = min(BLOCK, stop - p)
        s[GRAD_X : GRAD_Z + BLOCK] = 0
        _clear_gradient(s, count, channels)
        for i in range(count):
            _take(s, i, points, p + i)
        for view in range(matrices.shape[0]):
            project(s, matrices, view, nearest)
            place(s, height, width)
            for i in range(count):
                _read_gradient(s, i, p + i, view, grad_colours, grad_coordinates)
            _clear_gradient(s, count, channels)
            _pull(s, view, matrices, images, packed, bits, height, width, sums)
        for i in range(count):
            grad_points[p + i, 0] = s[GRAD_X + i]
            grad_points[p + i, 1] = s[GRAD_Y + i]
            grad_points[p + i, 2] = s[GRAD_Z + i]


@no_type_check
def backward_chosen(points, views, matrices, images, packed, bits, height, width, nearest, grad_colours,
                    grad_coordinates, grad_points, sums, start, stop):  # fmt: skip
    """As `backward`, for chosen planes; `grad_points` starts at zero."""
    channels = images.shape[1]
    s = np.zeros(FIRST_CHANNEL + BLOCK * channels, points.dtype)
    planes, m = matrices.shape[0], views.shape[1]
    first = np.empty(planes + 1, np.int64)
    order = np.empty((stop - start) * m, np.int64)
    _grouped(views, start, stop, planes, first, order)
    for view in range(planes):
        for k in range(first[view], first[view + 1], BLOCK):
            count = min(BLOCK, first[view + 1] - k)
            s[GRAD_X : GRAD_Z + BLOCK] = 0
            for i in range(count):
                _take(s, i, points, order[k + i] // m)
            project(s, matrices, view, nearest)
            place(s, height, width)
            for i in range(count):
                _read_gradient(s, i, order[k + i] // m, order[k + i] % m, grad_colours, grad_coordinates)
            _clear_gradient(s, count, channels)
            _pull(s, view, matrices, images, packed, bits, height, width, sums)
            for i in range(count):
                p = order[k + i] // m
                grad_points[p, 0] += s[GRAD_X + i]
                grad_points[p, 1] += s[GRAD_Y + i]
                grad_points[p, 2] += s[GRAD_Z + i]


@inner
@no_type_check
def _splat(s, i, p, j, grad_colours, height, width, plane):
    """Adds one lookup's gradient to the four pixels it was interpolated from; `plane` is (pixel, channel)."""
    if s[INSIDE + i] == 0:
        return
    u, v = s[U + i], s[V + i]
    x, y = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    right, below = 1 if width > 1 else 0, width if height > 1 else 0
    fx, fy = u - s.dtype.type(x), v - s.dtype.type(y)
    k = y * width + x
    wd = fx * fy
    wb, wc = fx - wd, fy - wd
    wa = s.dtype.type(1) - fx - wc
    for c in range(grad_colours.shape[2]):
        gradient = grad_colours[p, j, c]
        plane[k, c] += wa * gradient
        plane[k + right, c] += wb * gradient
        plane[k + below, c] += wc * gradient
        plane[k + below + right, c] += wd * gradient


@no_type_check
def image_backward(points, matrices, height, width, nearest, grad_colours, grad_images, start, stop):
    """The gradient with respect to planes start..stop; `grad_images` is (view, pixel, channel)."""
    s = np.zeros(FIRST_CHANNEL, points.dtype)
    for view in range(start, stop):
        plane = grad_images[view]
        for p in range(0, points.shape[0], BLOCK):
            count = min(BLOCK, points.shape[0] - p)
            for i in range(count):
                _take(s, i, points, p + i)
            project(s, matrices, view, nearest)
            place(s, height, width)
            for i in range(count):
                _splat(s, i, p + i, view, grad_colours, height, width, plane)


@no_type_check
def image_backward_chosen(points, views, matrices, height, width, nearest, grad_colours, grad_images, start, stop):
    """As `image_backward`, for chosen planes: only lookups in planes start..stop are followed."""
    s = np.zeros(FIRST_CHANNEL, points.dtype)
    m = views.shape[1]
    order = np.empty((matrices.shape[0], BLOCK), np.int64)
    filled = np.zeros(matrices.shape[0], np.int64)
    total = points.shape[0] * m
    for k in range(total + matrices.shape[0]):  # the last rounds empty the half-full blocks
        view = views[k // m, k % m] if k < total else k - total
        if view < start or view >= stop:
            continue
        if k < total:
            order[view, filled[view]] = k
            filled[view] += 1
        if filled[view] < BLOCK and k < total:
            continue
        for i in range(filled[view]):
            _take(s, i, points, order[view, i] // m)
        project(s, matrices, view, nearest)
        place(s, height, width)
        for i in range(filled[view]):
            _splat(s, i, order[view, i] // m, order[view, i] % m, grad_colours, height, width, grad_images[view])
        filled[view] = 0


_LOOKUP = "T[:, ::1], {views}T[:, :, ::1], T[:, :, :, ::1], uint32[::1], int64, int64, int64, "
_SIGNATURES = {
    forward: _LOOKUP + "T, T, T[::1], T[::1], uint8[::1], int64, int64",
    backward: _LOOKUP + "T, T[:, :, :], T[:, :, :], T[:, ::1], float64[:, ::1], int64, int64",
    image_backward: "T[:, ::1], {views}T[:, :, ::1], int64, int64, T, T[:, :, :], T[:, :, ::1], int64, int64",
}
_CHOSEN = {forward: forward_chosen, backward: backward_chosen, image_backward: image_backward_chosen}
_BY_NAME = {"forward": forward, "backward": backward, "image_backward": image_backward}


def _cache_folder() -> str:
    """Where machine code is kept: numba itself only notices changes of this file, so the sources are in the name."""
    here = Path(__file__).parent
    sources = b"".join((here / name).read_bytes() for name in ("vector_memory.py", "blocks.py", "kernels_cpu.py"))
    base = numba.config.CACHE_DIR or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "hyperplanes" / f"kernels-{hashlib.sha256(sources).hexdigest()[:12]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError:
        return tempfile.mkdtemp(prefix="hyperplanes-kernels-")


@functools.cache
def compiled(name: str, dtype: str, chosen: bool) -> Callable[..., None]:
    """The machine code of a kernel: "forward", "backward" or "image_backward", for "float32" or "float64"."""
    function = _BY_NAME[name]
    signature = _SIGNATURES[function].format(views="int64[:, ::1], " if chosen else "").replace("T", dtype)
    options = {"fastmath": {"contract", "reassoc", "arcp", "nsz"}, "error_model": "numpy", "nogil": True}
    kept = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _cache_folder()
    try:
        return njit(f"void({signature})", cache=True, **options)(_CHOSEN[function] if chosen else function)
    finally:
        numba.config.CACHE_DIR = kept
