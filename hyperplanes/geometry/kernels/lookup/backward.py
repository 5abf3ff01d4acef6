"""The backward loops of lookup and sampling on the CPU; see `forward` for how work and memory are laid out.

Incoming gradients have any strides. They are passed as flat memory with the strides of (point, view,
channel) as a tuple; where the stride of points is 1, as for gradients laid out like the results, LLVM reads whole
vectors.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.llvm import add_pixels, load, store
from hyperplanes.geometry.kernels.lookup.blocks import (
    BLOCK,
    CHANNELS,
    COLUMN,
    GRAD_U,
    GRAD_V,
    INSIDE,
    ROW,
    U,
    V,
    back_project,
    copy,
    inlined,
    scratch,
    start_gradient,
)
from hyperplanes.geometry.kernels.lookup.forward import locate
from hyperplanes.geometry.kernels.lookup.interpolation import interleave, pull_packed, pull_pixels, pull_plane, room

__all__ = ["backward", "image_backward"]


@no_type_check
def backward(points, pitch, matrices, given, by, images, packed, bits, height, width, min_z, grad_colours, per,
             grad_coordinates, per_coordinate, grad_points, sums, segments):  # fmt: skip
    """Gradients with respect to points and matrices, or to the given coordinates.

    Those of points are added to `grad_points`, rows of x, y and z; those of matrices to `sums` (view, 12). Those of
    coordinates are written to `grad_points` as (view, column and row, point).
    """
    channels, size = images.shape[1], height * width
    s, pixels = scratch(images.dtype, channels), room(images, bits, segments)
    half = s.dtype.type(0.5)
    per_column, per_row = half * s.dtype.type(width - 1), half * s.dtype.type(height - 1)
    for index in range(len(segments)):
        view, begin, end = segments[index, 0], segments[index, 1], segments[index, 2]
        if len(pixels):
            interleave(images, view, pixels)
        for p in range(begin, end, BLOCK):
            count = min(BLOCK, end - p)
            locate(s, points, pitch, matrices, given, by, view, p, count, height, width, min_z, s, COLUMN, ROW)
            # Incoming gradients, zero in the lanes without a point.
            for c in range(channels):
                at = p * per[0] + view * per[1] + c * per[2]
                copy(s, CHANNELS + c * BLOCK, count, grad_colours, at, per[0])
            # Gradients with respect to pixels: of the coordinates, then of the interpolation.
            if points is not None:
                at = p * per_coordinate[0] + view * per_coordinate[1]
                copy(s, COLUMN, count, grad_coordinates, at, per_coordinate[0])
                copy(s, ROW, count, grad_coordinates, at + per_coordinate[2], per_coordinate[0])
                start_gradient(s, height, width)
            if given is not None:
                s[GRAD_U : GRAD_V + BLOCK] = 0
            if bits:
                pull_packed(s, packed, view * size, height, width, bits)
            elif len(pixels):
                pull_pixels(s, pixels, height, width)
            else:
                for c in range(channels):
                    pull_plane(s, images, (view * channels + c) * size, height, width, c)
            # From pixels to points and matrices, or to the coordinates.
            if points is not None:
                back_project(s, points, p, pitch, matrices, view, grad_points, sums)
            if given is not None:
                at = 2 * view * pitch + p
                for i in range(BLOCK):
                    store(grad_points, at + i, load(s, GRAD_U + i) * per_column)
                    store(grad_points, at + pitch + i, load(s, GRAD_V + i) * per_row)


@no_type_check
def image_backward(points, pitch, matrices, given, by, height, width, min_z, grad_colours, per, channels, pixel,
                   grad_images, segments):  # fmt: skip
    """Gradients with respect to the planes of the segments; no two threads may share a plane.

    `grad_images` is flat (view, row, column, channel), `pixel` numbers a pixel, with one spare pixel at the end, since
    an image one pixel wide has zero weight on a neighbour that it lacks.
    """
    s = scratch(grad_images.dtype, 0)
    for index in range(len(segments)):
        view, begin, end = segments[index, 0], segments[index, 1], segments[index, 2]
        plane = view * height * width * pixel
        for p in range(begin, end, BLOCK):
            count = min(BLOCK, end - p)
            locate(s, points, pitch, matrices, given, by, view, p, count, height, width, min_z, s, COLUMN, ROW)
            for i in range(count):
                if load(s, INSIDE + i) > 0:
                    at = (p + i) * per[0] + view * per[1]
                    _scatter(s, i, at, per[2], grad_colours, height, width, channels, pixel, plane, grad_images)


@inlined
@no_type_check
def _scatter(s, i, at, step, grad_colours, height, width, channels, pitch, start, plane):
    """Adds one point's gradient to the four pixels it was interpolated from; pixels lie `pitch` numbers apart."""
    # The upper left pixel and the bilinear weights of all four.
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
