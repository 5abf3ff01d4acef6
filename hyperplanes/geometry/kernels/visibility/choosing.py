"""The CPU kernel of `visibility.VisibilityPlanes.choose`: the penalty of every view of a point, and the best views.

All views of a point are computed at once, in loops that LLVM vectorises. Their numbers lie in one scratch array, one
row of `pitch` values a quantity (the constants below).
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hyperplanes.geometry.kernels.llvm import load, load_int, read, store, store_int
from hyperplanes.geometry.kernels.lookup.blocks import inlined
from hyperplanes.geometry.lookup_torch import BORDER_TOLERANCE

__all__ = ["choose", "judge", "least", "place", "rank"]

# Rows of the scratch: the direction from the camera, depth behind the hull, opacity and penalty, which are results;
# then the distance, whether the view shows the point, the fractions of a pixel, the pixel, the score by direction, the
# angle in it, and how many pixels inside the margin of a border the point lies.
X, Y, Z, BEHIND, OPACITY, PENALTY, DISTANCE, SHOWN, ACROSS, DOWN, AT, SCORE, TURN, INSIDE = range(14)
RESULTS, ROWS = 6, 14


@inlined
@no_type_check
def place(s, pitch, total, x, y, z, cameras, shape, min_z):
    """Projects a point into every view: direction, distance, whether it is shown, pixel and fractions, and margins."""
    number = s.dtype.type
    zero, one = number(0), number(1)
    height, width = np.int32(shape[1]), np.int32(shape[2])
    low, right, bottom = (
        number(-BORDER_TOLERANCE),
        number(width - 1 + BORDER_TOLERANCE),
        number(height - 1 + BORDER_TOLERANCE),
    )
    last_column, last_row = number(width - 1), number(height - 1)
    most_column, most_row = number(max(width - 2, 0)), number(max(height - 2, 0))
    for k in range(total):
        # the ray from the camera's centre: its length, later its direction
        dx, dy, dz = x - read(cameras, 0, k), y - read(cameras, pitch, k), z - read(cameras, 2 * pitch, k)
        square = dx * dx + dy * dy + dz * dz
        distance = np.sqrt(square)
        reciprocal = one / max(distance, number(1e-30))
        # projection by the view's 3 x 4 matrix
        m = 3 * pitch
        u = read(cameras, m, k) * x + read(cameras, m + pitch, k) * y
        u += read(cameras, m + 2 * pitch, k) * z + read(cameras, m + 3 * pitch, k)
        m += 4 * pitch
        v = read(cameras, m, k) * x + read(cameras, m + pitch, k) * y
        v += read(cameras, m + 2 * pitch, k) * z + read(cameras, m + 3 * pitch, k)
        m += 4 * pitch
        camera_z = read(cameras, m, k) * x + read(cameras, m + pitch, k) * y
        camera_z += read(cameras, m + 2 * pitch, k) * z + read(cameras, m + 3 * pitch, k)
        front = camera_z > min_z
        per_z = one / (camera_z if front else one)
        u, v = u * per_z, v * per_z
        # whether the pixel lies in the image; its upper left neighbour and the fractions beyond it
        shown = front & (u >= low) & (u <= right) & (v >= low) & (v <= bottom) & (read(cameras, 15 * pitch, k) > zero)
        u, v = (min(max(u, zero), last_column) if shown else zero), (min(max(v, zero), last_row) if shown else zero)
        column, row = np.int32(min(u, most_column)), np.int32(min(v, most_row))
        m = 17 * pitch
        inside = max(read(cameras, m, k) - u, read(cameras, m + pitch, k) - (last_column - u))
        m += 2 * pitch
        inside = max(inside, max(read(cameras, m, k) - v, read(cameras, m + pitch, k) - (last_row - v)))
        store(s, INSIDE * pitch + k, max(inside, zero))
        store(s, X * pitch + k, dx * reciprocal)
        store(s, Y * pitch + k, dy * reciprocal)
        store(s, Z * pitch + k, dz * reciprocal)
        store(s, DISTANCE * pitch + k, distance)
        store(s, SHOWN * pitch + k, one if shown else zero)
        store(s, ACROSS * pitch + k, u - number(column))
        store(s, DOWN * pitch + k, v - number(row))
        store_int(s, AT * pitch, k, np.int32(2 * ((np.int32(k) * height + row) * width + column)))


@inlined
@no_type_check
def judge(s, pitch, total, cameras, maps, shape, limits):
    """Reads depth and opacity where a point falls into each view, and computes the penalties."""
    number = s.dtype.type
    zero, one = number(0), number(1)
    across_next, down_next = np.int32(2 * min(shape[2] - 1, 1)), np.int32(2 * shape[2] * min(shape[1] - 1, 1))
    per_unit, tolerance, deepest = limits[1], limits[2], limits[3]
    partly, whole, unseen, steep, highest = limits[4], limits[5], limits[6], limits[8], limits[9]
    lowest, per_pixel, halfway, end = limits[10], limits[11], limits[12], limits[13]
    for k in range(total):
        at, across, down = load_int(s, AT * pitch, k), load(s, ACROSS * pitch + k), load(s, DOWN * pitch + k)
        right, below = np.int32(at + across_next), np.int32(at + down_next)
        beyond = np.int32(below + across_next)
        # depth of the surface there, bilinear
        a, b = read(maps, 0, at), read(maps, 0, below)
        a, b = a + across * (read(maps, 0, right) - a), b + across * (read(maps, 0, beyond) - b)
        depth = a + down * (b - a)
        # opacity of the mask there, bilinear
        a, b = read(maps, 1, at), read(maps, 1, below)
        a, b = a + across * (read(maps, 1, right) - a), b + across * (read(maps, 1, beyond) - b)
        opacity = a + down * (b - a)
        # depth of the point behind the surface, in radii, and its penalty
        shown = load(s, SHOWN * pitch + k) > zero
        behind = (load(s, DISTANCE * pitch + k) - depth) * per_unit
        penalty = min(max(steep * (behind - tolerance), lowest), deepest)
        penalty = min(penalty + (partly if opacity < whole else zero), highest) + read(cameras, 16 * pitch, k)
        # in the margin of a border that crops the object: rising towards it
        cut = per_pixel * load(s, INSIDE * pitch + k)
        penalty = max(penalty, zero) + halfway * cut / (end - cut) if cut > zero else penalty
        store(s, BEHIND * pitch + k, behind if shown else zero)
        store(s, OPACITY * pitch + k, opacity if shown else one)
        store(s, PENALTY * pitch + k, penalty if shown else unseen)


@inlined
@no_type_check
def _acos(x):
    """The arc cosine within 1e-7, without a call, so that loops are vectorised (Abramowitz and Stegun, 4.4.46)."""
    n = type(x)
    a = abs(x)
    series = n(-0.0012624911)
    series = series * a + n(0.0066700901)
    series = series * a + n(-0.0170881256)
    series = series * a + n(0.0308918810)
    series = series * a + n(-0.0501743046)
    series = series * a + n(0.0889789874)
    series = series * a + n(-0.2145988016)
    series = series * a + n(1.5707963050)
    angle = np.sqrt(max(n(1) - a, n(0))) * series
    return angle if x >= 0 else n(np.pi) - angle


@inlined
@no_type_check
def rank(s, pitch, total, along_x, along_y, along_z, by_angle):
    """The score of each view: the angle between its ray and a direction, plus its weighted penalty."""
    number = s.dtype.type
    zero, one = number(0), number(1)
    for k in range(total):
        cosine = along_x * load(s, X * pitch + k) + along_y * load(s, Y * pitch + k) + along_z * load(s, Z * pitch + k)
        turn = _acos(min(max(cosine, -one), one))
        store(s, TURN * pitch + k, turn)
        store(s, SCORE * pitch + k, turn + by_angle * max(load(s, PENALTY * pitch + k), zero))


@inlined
@no_type_check
def least(s, pitch, total, row, count, views, scores, start):
    """Writes the `count` views of the least numbers in a row of the scratch, best first, from `start` on.

    If all numbers are NaN, as for a point that is not finite, the first views are taken.
    """
    for place in range(count):
        scores[place], views[start + place] = np.inf, place
    for view in range(total):
        score = load(s, row * pitch + view)
        if score < scores[count - 1]:
            place = count - 1
            while place > 0 and scores[place - 1] > score:
                scores[place], views[start + place] = scores[place - 1], views[start + place - 1]
                place -= 1
            scores[place], views[start + place] = score, view


@inlined
@no_type_check
def _keep(s, pitch, count, views, values, start):
    """Writes the results of the chosen views."""
    for place in range(start, start + count):
        for result in range(RESULTS):
            values[RESULTS * place + result] = load(s, result * pitch + views[place])


@no_type_check
def choose(
    points, directions, cameras, maps, shape, limits, best, best_values, near, near_values, overall, start, stop
):
    """Writes the chosen views of points start..stop. All arrays are flat.

    `cameras` holds 21 rows, a value a view and `pitch` apart: the three coordinates of its centre, the 3 x 4 projection
    matrix, 0 where it is masked, its penalty offset, and the pixels of its margins. `maps` (view, row, column, 2) hold
    depth and opacity. `shape` is the number of views, height, width, the numbers of chosen views, and the pitch;
    `limits` min_z, 1 / radius, the tolerance, deepest and partly of `chosen_views.Penalties`, OPAQUE_MASK,
    INVISIBLE_PENALTY, PENALTY_RADIANS, steep, highest, least, 1 / the pixels of a margin, BORDER_PENALTY and
    BORDER_POLE. `best` and `near` (point, chosen) get indices of views, their values (point, chosen, 6) direction,
    depth behind the hull, opacity and penalty of each, and `overall` (point, 2) the least opacity and the number of the
    views that show the point. Where there are no directions nothing is written to `near`.
    """
    number = limits.dtype.type
    total, best_count, near_count, pitch = shape[0], shape[3], shape[4], shape[5]
    s, scores = np.empty(ROWS * pitch, limits.dtype), np.empty(max(best_count, near_count, 1), limits.dtype)
    for point in range(start, stop):
        at = 3 * point
        # depth, opacity and penalty of each view
        place(s, pitch, total, points[at], points[at + 1], points[at + 2], cameras, shape, limits[0])
        judge(s, pitch, total, cameras, maps, shape, limits)
        # over all views: least opacity, and how many show it
        covered, seen = number(1), number(0)
        for k in range(total):
            covered = min(covered, load(s, OPACITY * pitch + k))
            seen += load(s, SHOWN * pitch + k)
        overall[2 * point], overall[2 * point + 1] = covered, seen
        # the views that see it best
        if best_count:
            least(s, pitch, total, PENALTY, best_count, best, scores, point * best_count)
            _keep(s, pitch, best_count, best, best_values, point * best_count)
        # those whose rays are closest to its direction
        if near_count:
            rank(s, pitch, total, directions[at], directions[at + 1], directions[at + 2], limits[7])
            least(s, pitch, total, SCORE, near_count, near, scores, point * near_count)
            _keep(s, pitch, near_count, near, near_values, point * near_count)
