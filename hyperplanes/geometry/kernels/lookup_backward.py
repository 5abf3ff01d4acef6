"""The CPU kernels of the fused lookup's gradient; see `lookup_forward` for how they are arranged.

Incoming gradients have whatever strides autograd gives them. They come flat, with the strides of (point, view, channel)
as a tuple; where a stride over points is 1, as for gradients laid out like the results, LLVM reads whole vectors.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.blocks import (
    BLOCK,
    CHANNELS,
    COLUMN,
    GRAD_X,
    GRAD_Y,
    GRAD_Z,
    INSIDE,
    ROW,
    U,
    V,
    X,
    back_project,
    copy,
    copy_pairs,
    inlined,
    inner,
    place,
    project,
    start_pull,
)
from hyperplanes.geometry.kernels.interpolation import interleave, pull_packed, pull_pixels, pull_plane, room
from hyperplanes.geometry.kernels.llvm import add_pixels, load
from hyperplanes.geometry.kernels.lookup_forward import grouped, scratch, take

__all__ = ["backward", "backward_chosen", "clear", "image_backward", "image_backward_chosen", "splat"]


@inlined
@no_type_check
def clear(s, count, channels):
    """Zero gradients in the lanes from `count` on, which hold no lookup."""
    for i in range(count, BLOCK):
        s[COLUMN + i] = 0
        s[ROW + i] = 0
        for c in range(channels):
            s[CHANNELS + c * BLOCK + i] = 0


@inner
@no_type_check
def _pull(s, points, at, pitch, view, matrices, images, packed, bits, pixels, height, width, nearest, gradients, into,
          sums):  # fmt: skip
    """The gradients in COLUMN, ROW and the channels' rows -> the points' gradients and the matrix sums."""
    project(s, points, at, pitch, matrices, view, nearest)
    start_pull(s, height, width)
    place(s, s, COLUMN, ROW, height, width)
    size, channels = height * width, images.shape[1]
    if bits:
        pull_packed(s, packed, view * size, height, width, bits)
    elif len(pixels):
        pull_pixels(s, pixels, height, width)
    else:
        for c in range(channels):
            pull_plane(s, images, (view * channels + c) * size, height, width, c)
    back_project(s, points, at, pitch, matrices, view, gradients, into, sums)


@no_type_check
def backward(points, pitch, matrices, images, packed, bits, height, width, nearest, grad_colours, per,
             grad_coordinates, by, grad_points, sums, total, start, stop):  # fmt: skip
    """Gradients with respect to points start..stop, and their share of the matrices' gradient, added to `sums`."""
    planes, channels = images.shape[0], images.shape[1]
    s, pixels = scratch(points.dtype, channels), room(images, bits, stop - start if planes > 1 else 0)
    for view in range(planes):
        if len(pixels):
            interleave(images, view, pixels)
        for p in range(start, stop, BLOCK):
            count = min(BLOCK, total - p)
            copy_pairs(s, count, grad_coordinates, p * by[0] + view * by[1], by)
            for c in range(channels):
                at = p * per[0] + view * per[1] + c * per[2]
                copy(s, CHANNELS + c * BLOCK, count, grad_colours, at, per[0])
            clear(s, count, channels)
            _pull(s, points, p, pitch, view, matrices, images, packed, bits, pixels, height, width, nearest,
                  grad_points, p, sums)  # fmt: skip


@no_type_check
def backward_chosen(points, pitch, views, matrices, images, packed, bits, height, width, nearest, grad_colours,
                    per, grad_coordinates, by, grad_points, sums, total, start, stop):  # fmt: skip
    """As `backward`, for chosen planes; `grad_points` starts at zero."""
    planes, channels, m = images.shape[0], images.shape[1], views.shape[1]
    s = scratch(points.dtype, channels)
    first = np.empty(planes + 1, np.int64)
    order = np.empty((stop - start) * m, np.int64)
    grouped(views, start, stop, planes, first, order)
    for view in range(planes):
        for begin in range(first[view], first[view + 1], BLOCK):
            count = min(BLOCK, first[view + 1] - begin)
            s[GRAD_X : GRAD_Z + BLOCK] = 0
            for i in range(count):
                p, j = order[begin + i] // m, order[begin + i] % m
                take(s, i, points, pitch, p)
                at = p * by[0] + j * by[1]
                s[COLUMN + i] = grad_coordinates[at]
                s[ROW + i] = grad_coordinates[at + by[2]]
                for c in range(channels):
                    s[CHANNELS + c * BLOCK + i] = grad_colours[p * per[0] + j * per[1] + c * per[2]]
            clear(s, count, channels)
            _pull(s, s, X, BLOCK, view, matrices, images, packed, bits, s[:0], height, width, nearest, s, GRAD_X, sums)
            for i in range(count):
                p = order[begin + i] // m
                grad_points[p] += s[GRAD_X + i]
                grad_points[pitch + p] += s[GRAD_Y + i]
                grad_points[2 * pitch + p] += s[GRAD_Z + i]


@inlined
@no_type_check
def splat(s, i, at, step, grad_colours, height, width, channels, pitch, start, plane):
    """Adds one lookup's gradient to the four pixels it was interpolated from; pixels lie `pitch` numbers apart."""
    u, v = load(s, U + i), load(s, V + i)
    x, y = min(np.int64(u), max(width - 2, 0)), min(np.int64(v), max(height - 2, 0))
    fx, fy = u - s.dtype.type(x), v - s.dtype.type(y)
    wd = fx * fy
    wb, wc = fx - wd, fy - wd
    wa = s.dtype.type(1) - fx - wc
    top = start + (y * width + x) * pitch
    low = top + (width * pitch if height > 1 else 0)
    if channels == 3:
        first, second = load(grad_colours, at), load(grad_colours, at + step)
        third = load(grad_colours, at + 2 * step)
        add_pixels(plane, top, wa, wb, first, second, third)
        add_pixels(plane, low, wc, wd, first, second, third)
    else:
        for c in range(channels):
            gradient = grad_colours[at + c * step]
            plane[top + c] += wa * gradient
            plane[top + pitch + c] += wb * gradient
            plane[low + c] += wc * gradient
            plane[low + pitch + c] += wd * gradient


@no_type_check
def image_backward(points, pitch, matrices, height, width, nearest, grad_colours, per, channels, pixel, grad_images,
                   total, start, stop):  # fmt: skip
    """The gradient with respect to planes start..stop.

    `grad_images` is flat (view, row, column, channel), `pixel` numbers a pixel, with one spare pixel at the end, since
    an image one pixel wide has zero weight on a neighbour that it lacks.
    """
    s = scratch(points.dtype, 0)
    for view in range(start, stop):
        plane = view * height * width * pixel
        for p in range(0, total, BLOCK):
            project(s, points, p, pitch, matrices, view, nearest)
            place(s, s, COLUMN, ROW, height, width)
            for i in range(min(BLOCK, total - p)):
                if load(s, INSIDE + i) > 0:
                    at = (p + i) * per[0] + view * per[1]
                    splat(s, i, at, per[2], grad_colours, height, width, channels, pixel, plane, grad_images)


@no_type_check
def image_backward_chosen(points, pitch, views, matrices, height, width, nearest, grad_colours, per, channels, pixel,
                          grad_images, total, start, stop):  # fmt: skip
    """As `image_backward`, for chosen planes: only lookups in planes start..stop are followed."""
    s = scratch(points.dtype, 0)
    m, planes = views.shape[1], matrices.shape[0]
    order = np.empty((planes, BLOCK), np.int64)
    filled = np.zeros(planes, np.int64)
    lookups = total * m
    for k in range(lookups + planes):  # the last rounds empty the half-full blocks
        view = views[k // m, k % m] if k < lookups else k - lookups
        if view < start or view >= stop:
            continue
        if k < lookups:
            order[view, filled[view]] = k
            filled[view] += 1
        if filled[view] < BLOCK and k < lookups:
            continue
        for i in range(filled[view]):
            take(s, i, points, pitch, order[view, i] // m)
        project(s, s, X, BLOCK, matrices, view, nearest)
        place(s, s, COLUMN, ROW, height, width)
        plane = view * height * width * pixel
        for i in range(filled[view]):
            if load(s, INSIDE + i) > 0:
                at = order[view, i] // m * per[0] + order[view, i] % m * per[1]
                splat(s, i, at, per[2], grad_colours, height, width, channels, pixel, plane, grad_images)
        filled[view] = 0
