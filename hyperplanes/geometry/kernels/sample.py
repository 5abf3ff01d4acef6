"""The CPU kernels of sampling at given coordinates, and of its gradient; the blocks are those of the lookup.

Work comes in pieces of `chunk` points on one plane, numbered plane after plane, so that threads can share it while a
plane's pixels stay in the cache, interleaved first where a piece has more points than the plane has pixels: what the
threads take for that is then less than the results. Coordinates and incoming gradients lie as they like, given as
their memory with the strides of (point, view, column and row or channel); results are planar, (view, channel, point),
in rows of `pitch`.
"""

from __future__ import annotations

from typing import no_type_check

from hyperplanes.geometry.kernels.blocks import (
    BLOCK,
    CHANNELS,
    GRAD_U,
    GRAD_V,
    INSIDE,
    copy,
    copy_pairs,
    inner,
    locate,
)
from hyperplanes.geometry.kernels.interpolation import (
    fetch_packed,
    fetch_pixels,
    fetch_plane,
    interleave,
    pull_packed,
    pull_pixels,
    pull_plane,
    room,
)
from hyperplanes.geometry.kernels.llvm import load, store
from hyperplanes.geometry.kernels.lookup_backward import splat
from hyperplanes.geometry.kernels.lookup_forward import scratch

__all__ = ["sample", "sample_backward"]


@inner
@no_type_check
def _arrive(s, coordinates, by, view, p, count, height, width):
    """The block of `count` points from p on -> clamped U, V; INSIDE. Lanes beyond hold what was there before."""
    copy_pairs(s, count, coordinates, p * by[0] + view * by[1], by)
    locate(s, height, width)


@no_type_check
def sample(images, packed, bits, height, width, background, coordinates, by, colours, pitch, total, chunk,
           start, stop):  # fmt: skip
    """Colours of pieces start..stop."""
    channels, size, pieces = images.shape[1], height * width, -(-total // chunk)
    s, pixels = scratch(colours.dtype, 0), room(images, bits, chunk // 2)
    for piece in range(start, stop):
        view, begin = piece // pieces, piece % pieces * chunk
        if len(pixels):
            interleave(images, view, pixels)
        for p in range(begin, min(begin + chunk, total), BLOCK):
            _arrive(s, coordinates, by, view, p, min(BLOCK, total - p), height, width)
            at = channels * view * pitch + p
            if bits:
                fetch_packed(s, colours, at, pitch, packed, view * size, height, width, bits, background)
            elif len(pixels):
                fetch_pixels(s, colours, at, pitch, pixels, height, width, background)
            else:
                for c in range(channels):
                    offset = (view * channels + c) * size
                    fetch_plane(s, colours, at + c * pitch, images, offset, height, width, background)


@no_type_check
def sample_backward(images, packed, bits, height, width, coordinates, by, grad_colours, per, grad_coordinates, pitch,
                    grad_images, pixel, total, chunk, start, stop):  # fmt: skip
    """Gradients with respect to coordinates and pixels, from pieces start..stop; none where its array is empty.

    `grad_images` is as in `lookup_backward.image_backward`; where it is asked for, a piece is a whole plane, since
    two threads must not add to one pixel.
    """
    channels, size, pieces = images.shape[1], height * width, -(-total // chunk)
    s = scratch(images.dtype, channels)
    pixels = room(images, bits, chunk // 2 if len(grad_coordinates) else 0)
    zero, half = s.dtype.type(0), s.dtype.type(0.5)
    per_column, per_row = half * s.dtype.type(width - 1), half * s.dtype.type(height - 1)
    for piece in range(start, stop):
        view, begin = piece // pieces, piece % pieces * chunk
        if len(pixels):
            interleave(images, view, pixels)
        for p in range(begin, min(begin + chunk, total), BLOCK):
            count = min(BLOCK, total - p)
            _arrive(s, coordinates, by, view, p, count, height, width)
            for c in range(channels):
                copy(s, CHANNELS + c * BLOCK, count, grad_colours, p * per[0] + view * per[1] + c * per[2], per[0])
            if len(grad_images):
                plane = view * size * pixel
                for i in range(count):
                    if load(s, INSIDE + i) > zero:
                        splat(s, i, CHANNELS + i, BLOCK, s, height, width, channels, pixel, plane, grad_images)
            if not len(grad_coordinates):
                continue
            for i in range(BLOCK):
                store(s, GRAD_U + i, zero)
                store(s, GRAD_V + i, zero)
            if bits:
                pull_packed(s, packed, view * size, height, width, bits)
            elif len(pixels):
                pull_pixels(s, pixels, height, width)
            else:
                for c in range(channels):
                    pull_plane(s, images, (view * channels + c) * size, height, width, c)
            at = 2 * view * pitch + p
            for i in range(BLOCK):
                store(grad_coordinates, at + i, load(s, GRAD_U + i) * per_column)
                store(grad_coordinates, at + pitch + i, load(s, GRAD_V + i) * per_row)
