"""Bilinear values of one plane for one block of points, and their gradients with respect to pixel positions.

Numba functions on the scratch of `blocks`, for three layouts of a plane: one channel of numbers; three channels packed
into 32 bits, (8, 8, 8) or (11, 11, 10), the first one lowest; and pixels of four numbers, the last one unused, with a
spare pixel at the end. A gather costs as much as its lanes, and takes 12 lanes a lookup from the first layout, 4 from
the second; the third is read without any, but has to be made first (`interleave`): for many points on one plane.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.llvm import bits_of, blend, load, load_int, read, slopes, spread, store, store_int
from hyperplanes.geometry.kernels.lookup.blocks import (
    ACROSS,
    BLOCK,
    CHANNELS,
    CORNER,
    DOWN,
    GRAD_U,
    GRAD_V,
    INSIDE,
    SLOPES,
    TILE,
    U,
    V,
    blended,
    inlined,
)

__all__ = [
    "fetch_packed",
    "fetch_pixels",
    "fetch_plane",
    "interleave",
    "pull_packed",
    "pull_pixels",
    "pull_plane",
    "room",
]


@inlined
@no_type_check
def _corner(s, i, height, width):
    """U, V -> the index of the upper left one of four neighbours, and the fractions of a pixel beyond it."""
    last_x, last_y = np.int32(max(width - 2, 0)), np.int32(max(height - 2, 0))
    u, v = load(s, U + i), load(s, V + i)
    x, y = min(np.int32(u), last_x), min(np.int32(v), last_y)
    return np.int32(y * np.int32(width) + x), u - s.dtype.type(x), v - s.dtype.type(y)


@inlined
@no_type_check
def _taps(images, offset, k, height, width):
    """The four neighbours from `k` on: the corner, right of it, below it, across.

    In an image of one row or column, the corner takes the place of missing neighbours.
    """
    right, below = np.int32(1 if width > 1 else 0), np.int32(width if height > 1 else 0)
    a, b = read(images, offset, k), read(images, offset, np.int32(k + right))
    k = np.int32(k + below)
    return a, b, read(images, offset, k), read(images, offset, np.int32(k + right))


@blended
@no_type_check
def fetch_plane(s, out, first, images, offset, height, width, background):
    """U, V, INSIDE -> bilinear values of the plane that starts at `offset`, into `out` from `first` on."""
    zero = s.dtype.type(0)
    for i in range(BLOCK):
        k, fx, fy = _corner(s, i, height, width)
        a, b, c, d = _taps(images, offset, k, height, width)
        left, right = a + fy * (c - a), b + fy * (d - b)  # down before across, as `blend` does
        value = left + fx * (right - left)
        store(out, first + i, value if load(s, INSIDE + i) > zero else background)


@inlined
@no_type_check
def pull_plane(s, images, offset, height, width, channel):
    """Adds one channel's part to GRAD_U, GRAD_V: its gradient times the slope of its plane."""
    for i in range(BLOCK):
        k, fx, fy = _corner(s, i, height, width)
        a, b, c, d = _taps(images, offset, k, height, width)
        gradient = load(s, CHANNELS + channel * BLOCK + i) * load(s, INSIDE + i)
        twist = (d - c) - (b - a)
        store(s, GRAD_U + i, load(s, GRAD_U + i) + gradient * ((b - a) + fy * twist))
        store(s, GRAD_V + i, load(s, GRAD_V + i) + gradient * ((c - a) + fx * twist))


@inlined
@no_type_check
def _format(bits):
    """Shift and mask of each channel of three in 32 bits."""
    mask, last = np.uint32((1 << bits) - 1), np.uint32((1 << (bits if bits == 8 else bits - 1)) - 1)
    return (np.uint32(0), mask), (np.uint32(bits), mask), (np.uint32(2 * bits), last)


@inlined
@no_type_check
def _mixed(words, weights, channel):
    """The weighted sum of one channel of four words."""
    shift, mask = channel
    value = weights[0] * bits_of(words[0], shift, mask) + weights[1] * bits_of(words[1], shift, mask)
    return value + (weights[2] * bits_of(words[2], shift, mask) + weights[3] * bits_of(words[3], shift, mask))


@inlined
@no_type_check
def _contracted(word, gradients, channels):
    """The sum over channels of gradient times value."""
    first, second, third = channels
    value = gradients[0] * bits_of(word, first[0], first[1]) + gradients[1] * bits_of(word, second[0], second[1])
    return value + gradients[2] * bits_of(word, third[0], third[1])


@inlined
@no_type_check
def fetch_packed(s, out, first, pitch, packed, offset, height, width, bits, background):
    """As `fetch_plane`, for all three channels of packed pixels; their values go `pitch` apart."""
    zero, one = s.dtype.type(0), s.dtype.type(1)
    red, green, blue = _format(bits)
    unit, unit_last = one / s.dtype.type(red[1]), one / s.dtype.type(blue[1])
    for i in range(BLOCK):
        k, fx, fy = _corner(s, i, height, width)
        words = _taps(packed, offset, k, height, width)
        wd = fx * fy
        weights = (one - fx - (fy - wd), fx - wd, fy - wd, wd)
        inside = load(s, INSIDE + i) > zero
        store(out, first + i, _mixed(words, weights, red) * unit if inside else background)
        store(out, first + pitch + i, _mixed(words, weights, green) * unit if inside else background)
        store(out, first + 2 * pitch + i, _mixed(words, weights, blue) * unit_last if inside else background)


@inlined
@no_type_check
def pull_packed(s, packed, offset, height, width, bits):
    """As `pull_plane`, for all three channels of packed pixels."""
    channels, one = _format(bits), s.dtype.type(1)
    unit, unit_last = one / s.dtype.type(channels[0][1]), one / s.dtype.type(channels[2][1])
    for i in range(BLOCK):
        k, fx, fy = _corner(s, i, height, width)
        a, b, c, d = _taps(packed, offset, k, height, width)
        inside = load(s, INSIDE + i)
        first = load(s, CHANNELS + i) * inside * unit
        second = load(s, CHANNELS + BLOCK + i) * inside * unit
        third = load(s, CHANNELS + 2 * BLOCK + i) * inside * unit_last
        # All four taps need the same sum over channels: contract channels first, then interpolate.
        g = (first, second, third)
        ga, gb, gc = _contracted(a, g, channels), _contracted(b, g, channels), _contracted(c, g, channels)
        twist = (_contracted(d, g, channels) - gc) - (gb - ga)
        store(s, GRAD_U + i, load(s, GRAD_U + i) + ((gb - ga) + fy * twist))
        store(s, GRAD_V + i, load(s, GRAD_V + i) + ((gc - ga) + fx * twist))


@inlined
@no_type_check
def room(images, bits, segments):
    """Memory for an interleaved plane; empty where segments have too few points for interleaving to pay off."""
    channels, height, width = images.shape[1:]
    points = 0
    for index in range(len(segments)):
        points = max(points, segments[index, 2] - segments[index, 1])
    pays = bits == 0 and channels == 3 and len(images) > 1 and 2 * points >= height * width
    return np.zeros(4 * (height * width + 1) if pays else 0, images.dtype)


@inlined
@no_type_check
def interleave(images, view, pixels):
    """A plane of three channels -> pixels of four numbers."""
    size, zero = images.shape[2] * images.shape[3], images.dtype.type(0)
    for i in range(size):
        store(pixels, 4 * i + 3, zero)  # four stores side by side are whole vectors, three are not
        store(pixels, 4 * i, read(images, 3 * view * size, i))
        store(pixels, 4 * i + 1, read(images, (3 * view + 1) * size, i))
        store(pixels, 4 * i + 2, read(images, (3 * view + 2) * size, i))


@inlined
@no_type_check
def _place_corners(s, height, width):
    """U, V -> CORNER, ACROSS, DOWN."""
    for i in range(BLOCK):
        k, fx, fy = _corner(s, i, height, width)
        store_int(s, CORNER, i, k)
        store(s, ACROSS + i, fx)
        store(s, DOWN + i, fy)


@inlined
@no_type_check
def fetch_pixels(s, out, first, pitch, pixels, height, width, background):
    """As `fetch_packed`, for an interleaved plane."""
    below, zero = 4 * (width if height > 1 else 0), s.dtype.type(0)
    _place_corners(s, height, width)
    for i in range(BLOCK):
        at = 4 * np.int64(load_int(s, CORNER, i))
        blend(pixels, at, below, load(s, ACROSS + i), load(s, DOWN + i), s, TILE + 4 * i)
    for i in range(0, BLOCK, 8):
        spread(s, TILE + 4 * i, s, SLOPES + i, BLOCK)
    for channel in range(3):
        row, to = SLOPES + channel * BLOCK, first + channel * pitch
        for i in range(BLOCK):
            store(out, to + i, load(s, row + i) if load(s, INSIDE + i) > zero else background)


@inlined
@no_type_check
def pull_pixels(s, pixels, height, width):
    """As `pull_packed`, for an interleaved plane."""
    below = 4 * (width if height > 1 else 0)
    _place_corners(s, height, width)
    for i in range(BLOCK):
        at = 4 * np.int64(load_int(s, CORNER, i))
        slopes(pixels, at, below, load(s, ACROSS + i), load(s, DOWN + i), s, TILE + 4 * i, 4 * BLOCK)
    for i in range(0, BLOCK, 8):
        spread(s, TILE + 4 * i, s, SLOPES + i, BLOCK)
        spread(s, TILE + 4 * (BLOCK + i), s, SLOPES + 3 * BLOCK + i, BLOCK)
    for row in range(0, 3 * BLOCK, BLOCK):
        for i in range(BLOCK):
            gradient = load(s, CHANNELS + row + i) * load(s, INSIDE + i)
            store(s, GRAD_U + i, load(s, GRAD_U + i) + gradient * load(s, SLOPES + row + i))
            store(s, GRAD_V + i, load(s, GRAD_V + i) + gradient * load(s, SLOPES + 3 * BLOCK + row + i))
