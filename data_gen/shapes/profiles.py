"""Closed planar outlines: the cross-sections that the solids are drawn through.

Every function returns an array (n, 2) of corners in counter-clockwise order, centred on the origin unless said
otherwise, in the unit of its arguments. Outlines that are to be lofted together need the same number of corners.
"""

from __future__ import annotations

import numpy as np

__all__ = ["airfoil", "ellipse", "polygon_area", "rectangle", "rounded_rectangle", "superellipse", "triangulate"]


def rectangle(width: float, height: float) -> np.ndarray:
    """Axis-aligned rectangle (4, 2), first corner at the lower left."""
    x, y = width / 2, height / 2
    return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])


def rounded_rectangle(width: float, height: float, radius: float, steps: int = 3) -> np.ndarray:
    """Rectangle with circular corners.

    Args:
        width: full extent along the first axis.
        height: full extent along the second axis.
        radius: corner radius; cut down to just under half of the shorter side.
        steps: edges a corner.

    Returns:
        Corners (4 * (steps + 1), 2), starting at the lower right.
    """
    radius = min(radius, 0.499 * width, 0.499 * height)
    centres = np.array([(1, -1), (1, 1), (-1, 1), (-1, -1)]) * (width / 2 - radius, height / 2 - radius)
    angles = np.linspace(0, np.pi / 2, steps + 1)
    corners = [
        centre + radius * np.stack([np.cos(angles + start), np.sin(angles + start)], 1)
        for centre, start in zip(centres, (-np.pi / 2, 0, np.pi / 2, np.pi), strict=True)
    ]
    return np.concatenate(corners)


def ellipse(radius_x: float, radius_y: float, corners: int = 16) -> np.ndarray:
    """Polygon (corners, 2) inscribed in an ellipse, first corner on the positive first axis."""
    angles = np.arange(corners) * (2 * np.pi / corners)
    return np.stack([radius_x * np.cos(angles), radius_y * np.sin(angles)], 1)


def superellipse(width: float, height: float, exponent: float, corners: int = 16) -> np.ndarray:
    """Polygon inscribed in |x / a|^e + |y / b|^e = 1: e = 2 is an ellipse, larger is boxier.

    Args:
        width: full extent along the first axis, 2 a.
        height: full extent along the second axis, 2 b.
        exponent: the e above, positive.
        corners: number of corners.

    Returns:
        Corners (corners, 2), the first on the positive first axis.
    """
    cosine, sine = ellipse(1.0, 1.0, corners).T
    cosine, sine = np.where(np.abs(cosine) < 1e-12, 0, cosine), np.where(np.abs(sine) < 1e-12, 0, sine)
    x = np.sign(cosine) * np.abs(cosine) ** (2 / exponent) * width / 2
    y = np.sign(sine) * np.abs(sine) ** (2 / exponent) * height / 2
    return np.stack([x, y], 1)


def airfoil(chord: float, thickness: float, steps: int) -> np.ndarray:
    """Symmetric wing section after the NACA four-digit thickness law, with a blunt trailing edge.

    Args:
        chord: length from the trailing edge at 0 to the leading edge at +chord, along the first axis.
        thickness: largest extent along the second axis.
        steps: edges a side.

    Returns:
        Corners (2 * steps + 1, 2): the trailing edge below, the lower side to the leading edge, the upper side back.
    """
    x = (1 - np.cos(np.linspace(0, np.pi, steps + 1))) / 2  # 0 at the leading edge
    half = 5 * (0.2969 * np.sqrt(x) - 0.1260 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1015 * x**4) * thickness
    along = (1 - x) * chord
    lower = np.stack([along, -half], 1)[::-1]
    upper = np.stack([along, half], 1)[1:]
    return np.concatenate([lower, upper])


def polygon_area(corners: np.ndarray) -> np.ndarray:
    """Signed areas (...) by the shoelace formula: positive for counter-clockwise corners (..., n, 2)."""
    x, y = corners[..., 0], corners[..., 1]
    following = np.concatenate([corners[..., 1:, :], corners[..., :1, :]], axis=-2)
    return (x * following[..., 1] - following[..., 0] * y).sum(axis=-1) / 2


def _cross(o: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Twice the signed area of the triangle o, a, b."""
    return (a[..., 0] - o[..., 0]) * (b[..., 1] - o[..., 1]) - (a[..., 1] - o[..., 1]) * (b[..., 0] - o[..., 0])


def _strip(count: int) -> np.ndarray:
    """Zigzag triangles (count - 2, 3) across a convex polygon."""
    steps = np.arange(count - 2)
    low, high = (steps + 1) // 2, count - 1 - steps // 2
    third = np.where(steps % 2 == 0, low + 1, high - 1)
    return np.stack([low, third, high], 1)


def triangulate(corners: np.ndarray) -> np.ndarray:
    """Cut a simple counter-clockwise polygon into triangles: a zigzag if it is convex, by clipping ears otherwise.

    Args:
        corners: polygon (n, 2), not self-intersecting, convex or not.

    Returns:
        Indices (n - 2, 3) into `corners`, counter-clockwise, using the corners only. An outline that crosses itself,
        so that no ear is left although more than three corners remain, is a ValueError.
    """
    turns = _cross(np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0))
    edges = np.roll(corners, -1, axis=0) - corners
    turned = np.arctan2(turns, (edges * np.roll(edges, 1, axis=0)).sum(axis=1)).sum()
    if (turns > 1e-9 * np.abs(turns).max()).all() and turned < 3 * np.pi:
        return _strip(len(corners))
    return np.array(_ears(corners))


def _ears(corners: np.ndarray) -> list[tuple[int, ...]]:
    """Triangles of a polygon (n, 2) by clipping the most equilateral ear, again and again."""
    left = list(range(len(corners)))
    triangles: list[tuple[int, ...]] = []
    while len(left) > 3:
        ring = corners[left]
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        size = _cross(before, ring, after)
        convex = np.flatnonzero(size > 0)
        a, b, c = before[convex, None], ring[convex, None], after[convex, None]
        inside = (_cross(a, b, ring) >= 0) & (_cross(b, c, ring) >= 0) & (_cross(c, a, ring) >= 0)
        for own in (-1, 0, 1):  # the ear's corners do not lie in its way
            inside[np.arange(len(convex)), (convex + own) % len(ring)] = False
        sides = ((b - a) ** 2).sum(-1) + ((c - b) ** 2).sum(-1) + ((a - c) ** 2).sum(-1)
        qualities = np.where(inside.any(axis=1), 0.0, size[convex] / sides[:, 0])
        best, best_quality = -1, 0.0
        for i, quality in zip(convex.tolist(), qualities.tolist(), strict=True):
            if quality > best_quality + 1e-9:
                best, best_quality = i, quality
        if best < 0:
            raise ValueError(f"expected a simple counter-clockwise polygon, got one without an ear: {ring.tolist()}")
        triangles.append((left[best - 1], left[best], left[(best + 1) % len(left)]))
        del left[best]
    triangles.append(tuple(left))
    return triangles
