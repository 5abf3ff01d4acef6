"""The forward loop of lookup and sampling on the CPU, around the block functions.

Work comes as segments (view, begin, end): points begin..end of one plane. Results are planar in memory, (view, channel,
point), so that a block is read and written as whole vectors, and all rows are `pitch` long, a multiple of BLOCK, so
that the last block may be written whole. One plane after the other is sampled at all points of a segment: its pixels
then stay in the cache, interleaved first where the segment is long enough.

Points are rows of x, y and z with the planes' projection matrices, or, where these are None, coordinates in [-1, 1] in
memory of any strides (point, view, axis). Each kernel is compiled for both, without branches on None.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.llvm import load, store
from hyperplanes.geometry.kernels.lookup.blocks import (
    BLOCK,
    INSIDE,
    inlined,
    place,
    project,
    scratch,
    unnormalize,
)
from hyperplanes.geometry.kernels.lookup.interpolation import fetch_packed, fetch_pixels, fetch_plane, interleave, room

__all__ = ["forward", "locate"]


@inlined
@no_type_check
def locate(s, points, pitch, matrices, given, by, view, p, count, height, width, min_z, out, column, row):
    """The `count` points from p on -> clamped U, V; INSIDE; of projected points also coordinates, as `place` writes."""
    if points is not None:
        project(s, points, p, pitch, matrices, view, min_z)
        place(s, out, column, row, height, width)
    if given is not None:
        unnormalize(s, count, given, p * by[0] + view * by[1], by, height, width)


@no_type_check
def forward(points, pitch, matrices, given, by, images, packed, bits, height, width, background, min_z, colours,
            coordinates, valid, grouped, segments):  # fmt: skip
    """Colours of all segments; for projected points also coordinates and validity.

    Where the points are `grouped` by view, the results have no dimension of views.
    """
    channels, size = images.shape[1], height * width
    s, pixels = scratch(images.dtype, 0), room(images, bits, segments)
    for index in range(len(segments)):
        view, begin, end = segments[index, 0], segments[index, 1], segments[index, 2]
        row = 0 if grouped else view * pitch  # in results of one number a point
        if len(pixels):
            interleave(images, view, pixels)
        for p in range(begin, end, BLOCK):
            # Project and clamp; write coordinates and validity.
            k = 2 * row + p
            locate(s, points, pitch, matrices, given, by, view, p, min(BLOCK, end - p), height, width, min_z,
                   coordinates, k, k + pitch)  # fmt: skip
            if points is not None:
                for i in range(BLOCK):
                    store(valid, row + p + i, np.uint8(load(s, INSIDE + i)))
            # Interpolate and write colours, by the layout of the plane.
            at = channels * row + p
            if bits:
                fetch_packed(s, colours, at, pitch, packed, view * size, height, width, bits, background)
            elif len(pixels):
                fetch_pixels(s, colours, at, pitch, pixels, height, width, background)
            else:
                for c in range(channels):
                    plane = (view * channels + c) * size
                    fetch_plane(s, colours, at + c * pitch, images, plane, height, width, background)
