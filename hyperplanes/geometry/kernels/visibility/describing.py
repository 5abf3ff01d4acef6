"""The CPU kernel of `visibility.VisibilityPlanes.describe`: what views show of a point, as rows for a network.

Views are chosen as by `choosing.choose`; colours are read only in the chosen ones. Rows have the order of the inputs
of the first layer, so that nothing is gathered or concatenated afterwards.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from hyperplanes.geometry.chosen_views import OCTAVES
from hyperplanes.geometry.kernels.llvm import load, load_int
from hyperplanes.geometry.kernels.lookup.blocks import inlined
from hyperplanes.geometry.kernels.visibility.choosing import (
    ACROSS,
    AT,
    BEHIND,
    DOWN,
    OPACITY,
    PENALTY,
    ROWS,
    SCORE,
    SHOWN,
    TURN,
    X,
    Y,
    Z,
    judge,
    least,
    place,
    rank,
)

__all__ = ["describe"]

BACKGROUND = 1.0
LEAST_TURN = math.acos(1 - 1e-6)  # of the angle between a view and a direction, as `fields.image_based` has it


@inlined
@no_type_check
def _bilinear(a, b, c, d, across, down, shift, mask):
    """One channel between four words: a, b above c, d; not yet divided by the mask."""
    number = type(across)
    left, right = number((a >> shift) & mask), number((b >> shift) & mask)
    left += down * (number((c >> shift) & mask) - left)
    right += down * (number((d >> shift) & mask) - right)
    return left + across * (right - left)


@inlined
@no_type_check
def _colour(s, pitch, view, packed, bits, width, height, colour):
    """The colour of the point in one view, the background where it is not shown."""
    number = s.dtype.type
    if not load(s, SHOWN * pitch + view) > number(0):
        colour[0] = colour[1] = colour[2] = number(BACKGROUND)
        return
    at = np.int64(load_int(s, AT * pitch, view)) >> 1
    right, below = np.int64(min(width - 1, 1)), np.int64(width * min(height - 1, 1))
    a, b, c, d = packed[at], packed[at + right], packed[at + below], packed[at + below + right]
    across, down = load(s, ACROSS * pitch + view), load(s, DOWN * pitch + view)
    most, last = np.uint32((1 << bits) - 1), np.uint32((1 << (bits if bits == 8 else bits - 1)) - 1)
    colour[0] = _bilinear(a, b, c, d, across, down, np.uint32(0), most) / number(most)
    colour[1] = _bilinear(a, b, c, d, across, down, np.uint32(bits), most) / number(most)
    colour[2] = _bilinear(a, b, c, d, across, down, np.uint32(2 * bits), last) / number(last)


@inlined
@no_type_check
def _encode(row, at, x, y, z, frequencies):
    """x, y, z and their sines and cosines from `at` on, as `fields.encoding.encode`; returns where the row goes on."""
    number = type(x)
    row[at], row[at + 1], row[at + 2] = x, y, z
    at += 3
    if frequencies:
        for axis in range(3):
            value, sine, cosine = row[at - 3 + axis], number(0), number(0)
            for octave in range(frequencies):
                if octave % OCTAVES == 0:
                    angle = value * number(1 << octave)
                    sine, cosine = number(math.sin(angle)), number(math.cos(angle))
                else:
                    sine, cosine = number(2) * sine * cosine, number(1) - number(2) * sine * sine
                row[at + 3 * octave + axis] = sine
                row[at + 3 * (frequencies + octave) + axis] = cosine
    return at + 6 * frequencies


@inlined
@no_type_check
def _interpolate(grid, row, at, x, y, z):
    """Trilinear features of a grid (x, y, z, channel) at a point of the unit cube, the first through a sigmoid."""
    number = type(x)
    side, channels = grid.shape[0], grid.shape[3]
    last, zero, one, half = number(side - 1), number(0), number(1), number(0.5)
    scale = half * number(side)
    x, y, z = (x + one) * scale - half, (y + one) * scale - half, (z + one) * scale - half
    x, y, z = (x if x > zero else zero), (y if y > zero else zero), (z if z > zero else zero)  # NaN becomes 0
    x, y, z = min(x, last), min(y, last), min(z, last)
    i, j, k = min(int(x), max(side - 2, 0)), min(int(y), max(side - 2, 0)), min(int(z), max(side - 2, 0))
    x, y, z = x - number(i), y - number(j), z - number(k)
    for channel in range(channels):
        row[at + channel] = zero
    for corner in range(8):
        right, up, behind = corner >> 2, corner >> 1 & 1, corner & 1
        weight = (x if right else one - x) * (y if up else one - y) * (z if behind else one - z)
        a, b, c = min(i + right, side - 1), min(j + up, side - 1), min(k + behind, side - 1)
        for channel in range(channels):
            row[at + channel] += weight * grid[a, b, c, channel]
    row[at] = one / (one + number(math.exp(-row[at])))


@inlined
@no_type_check
def _describe_best(s, pitch, packed, shape, chosen, numbers, covered, seen, row, at, colours, weights, colour):
    """Nine numbers of each of the best views, then eleven of all of them; returns where the row goes on."""
    number = s.dtype.type
    zero, one, two = number(0), number(1), number(2)
    total, height, width, slots, bits = shape[0], shape[1], shape[2], shape[3], shape[6]
    best = min(slots, total)
    unseen, fading, falloff = numbers[6], numbers[14], numbers[15]
    sum_of_weights = zero
    for index in range(best):
        view = chosen[index]
        penalty = load(s, PENALTY * pitch + view)
        valid = penalty < unseen
        _colour(s, pitch, view, packed, bits, width, height, colour)
        for channel in range(3):
            colours[index, channel] = two * colour[channel] - one if valid else zero
            row[at + channel] = colours[index, channel]
        row[at + 3] = number(math.tanh(falloff * load(s, BEHIND * pitch + view))) if valid else zero
        row[at + 4] = load(s, OPACITY * pitch + view) if valid else zero
        row[at + 5] = one if valid else zero
        row[at + 6] = load(s, X * pitch + view) if valid else zero
        row[at + 7] = load(s, Y * pitch + view) if valid else zero
        row[at + 8] = load(s, Z * pitch + view) if valid else zero
        weights[index] = number(math.exp(-fading * max(penalty, zero))) if valid else zero
        sum_of_weights += weights[index]
        at += 9
    for empty in range(at, at + 9 * (slots - best)):
        row[empty] = zero
    at += 9 * (slots - best)
    # Mean, variance and difference to the best of the colours; least opacity; number of views.
    sum_of_weights = max(sum_of_weights, number(1e-6))
    for channel in range(3):
        mean, variance = zero, zero
        for index in range(best):
            mean += weights[index] * colours[index, channel]
        mean /= sum_of_weights
        for index in range(best):
            difference = colours[index, channel] - mean
            variance += weights[index] * difference * difference
        row[at + channel] = mean
        row[at + 3 + channel] = variance / sum_of_weights
        row[at + 6 + channel] = colours[0, channel] - mean
    row[at + 9], row[at + 10] = covered, number(math.log(max(seen, one)))
    return at + 11


@inlined
@no_type_check
def _describe_nearest(s, pitch, packed, shape, chosen, scores, numbers, row, at, weights, shown, colour):
    """Seven numbers of each of the nearest views; their colours, and the logarithms of their weights in the blend."""
    number = s.dtype.type
    zero, one, two = number(0), number(1), number(2)
    total, height, width, slots, bits = shape[0], shape[1], shape[2], shape[4], shape[6]
    near, ranked = min(slots, total), min(slots + 1, total)
    unseen, by_angle, falloff, smallest, least_turn = (
        numbers[6],
        numbers[7],
        numbers[15],
        numbers[16],
        number(LEAST_TURN),
    )
    for index in range(ranked):  # the angle, and the score that weights the view
        view = chosen[index]
        angle = min(max(load(s, TURN * pitch + view), least_turn), number(math.pi) - least_turn)
        scores[index] = max(angle + by_angle * max(load(s, PENALTY * pitch + view), zero), smallest)
        if index < near:
            row[at + 7 * index + 3] = angle
    farthest = number(1.01) * scores[slots] if total > slots else two * number(1.01) * scores[near - 1]
    # the numbers of a view, as in `_describe_best`: with one function for both, the kernel takes 15 to 25 % longer
    for index in range(near):
        view = chosen[index]
        valid = load(s, PENALTY * pitch + view) < unseen
        _colour(s, pitch, view, packed, bits, width, height, colour)
        for channel in range(3):
            shown[index, channel] = colour[channel]
            row[at + channel] = two * colour[channel] - one if valid else zero
        row[at + 3] = row[at + 3] if valid else zero
        row[at + 4] = number(math.tanh(falloff * load(s, BEHIND * pitch + view))) if valid else zero
        row[at + 5] = load(s, OPACITY * pitch + view) if valid else zero
        row[at + 6] = one if valid else zero
        weights[index] = number(math.log(max(one / scores[index] - one / farthest, number(1e-6))))
        at += 7
    for empty in range(at, at + 7 * (slots - near)):
        row[empty] = zero


@no_type_check
def describe(
    points, directions, cameras, maps, surface, packed, grid, shape, numbers, sphere, rows, coverage, near_rows,
    near_weights, near_colours, start, stop,
):  # fmt: skip
    """Writes the network inputs of points start..stop.

    Where `rows` (point, number) have columns they get the encoded point; nine numbers of each of the best views; mean,
    variance and difference to the best colour, the least opacity and the logarithm of the number of views; and the
    features of `grid` (x, y, z, channel). `coverage` (point,) gets the least opacity.

    Where there are directions, the rows of `near_rows` get the encoded direction and seven numbers of each of the views
    nearest to it, `near_weights` (point, view) the logarithms of the weights of the unstructured lumigraph, and
    `near_colours` (point, view, 3) their colours. These views are chosen by `surface`, a map like
    `maps`, unless it is empty.

    `shape` is the number of views, height, width, the numbers of best and nearest views in a row, the pitch of
    `cameras`, the bits of a packed channel, and the frequencies of points and directions; `numbers` are the limits of
    `choosing.choose`, then WEIGHT_FALLOFF, FALLOFF and SMALLEST_ANGLE; `sphere` the centre and 1 / radius of the scene.
    The others are as in `choosing.choose`.
    """
    number = numbers.dtype.type
    zero, one = number(0), number(1)
    total, slots, near_slots, pitch = shape[0], shape[3], shape[4], shape[5]
    best, ranked = min(slots, total), min(near_slots + 1, total)
    s, scores = np.empty(ROWS * pitch, numbers.dtype), np.empty(max(best, ranked), numbers.dtype)
    chosen, colour = np.empty(max(best, ranked), np.int64), np.empty(3, numbers.dtype)
    colours, weights = np.empty((best, 3), numbers.dtype), np.empty(best, numbers.dtype)
    for point in range(start, stop):
        x, y, z = points[point, 0], points[point, 1], points[point, 2]
        place(s, pitch, total, x, y, z, cameras, shape, numbers[0])
        if rows.shape[1]:  # what the trunk reads of the best views
            row = rows[point]
            judge(s, pitch, total, cameras, maps, shape, numbers)
            least(s, pitch, total, PENALTY, best, chosen, scores, 0)
            covered, seen = one, zero
            for view in range(total):
                covered = min(covered, load(s, OPACITY * pitch + view))
                seen += load(s, SHOWN * pitch + view)
            coverage[point] = covered
            x, y, z = (x - sphere[0]) * sphere[3], (y - sphere[1]) * sphere[3], (z - sphere[2]) * sphere[3]
            at = _encode(row, 0, x, y, z, shape[7])
            at = _describe_best(
                s, pitch, packed, shape, chosen, numbers, covered, seen, row, at, colours, weights, colour
            )
            if grid.shape[3]:
                _interpolate(grid, row, at, x, y, z)
        if near_rows.shape[1]:  # what the colour head reads of the nearest ones
            row = near_rows[point]
            if len(surface):
                judge(s, pitch, total, cameras, surface, shape, numbers)
            elif not rows.shape[1]:
                judge(s, pitch, total, cameras, maps, shape, numbers)
            x, y, z = directions[point, 0], directions[point, 1], directions[point, 2]
            rank(s, pitch, total, x, y, z, numbers[7])
            least(s, pitch, total, SCORE, ranked, chosen, scores, 0)
            at = _encode(row, 0, x, y, z, shape[8])
            _describe_nearest(
                s, pitch, packed, shape, chosen, scores, numbers, row, at, near_weights[point], near_colours[point],
                colour,
            )  # fmt: skip
