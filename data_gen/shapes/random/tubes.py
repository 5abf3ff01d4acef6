"""Closed surfaces of rings of points, dense enough to be displaced: generalised cylinders.

A generalised cylinder (Agin and Binford 1976) is an outline that is carried along a curve while it changes. With a
straight curve it is a box, a prism, a cylinder, a cone, a ball or a lathe; with outlines that change a loft; with a
bent curve a sweep, and with a closed one a ring.
"""

from __future__ import annotations

import numpy as np

from data_gen.shapes.profiles import ellipse
from data_gen.shapes.solids import Solid, collapsed, signed_volume, skin

__all__ = ["bar", "frames_along", "subdivided", "surface", "tube"]


def subdivided(corners: np.ndarray, count: int) -> np.ndarray:
    """A polygon (n, 2) with further points on its edges: (count, 2), its corners among them."""
    length = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    pieces = np.maximum(1, np.floor(count * length / length.sum())).astype(int)
    while pieces.sum() != count:  # the edge with the longest pieces gets one more, that with the shortest one less
        if pieces.sum() < count:
            pieces[np.argmax(length / pieces)] += 1
        else:
            pieces[np.argmin(np.where(pieces > 1, length / pieces, np.inf))] -= 1
    share = np.concatenate([np.arange(n) / n for n in pieces])[:, None]
    start = np.repeat(corners, pieces, axis=0)
    end = np.repeat(np.roll(corners, -1, axis=0), pieces, axis=0)
    return (1 - share) * start + share * end


def frames_along(spine: np.ndarray, closed: bool = False) -> np.ndarray:
    """Rotation matrices (k, 3, 3) along a curve (k, 3), whose third column is its direction, with the least twist.

    The frame is carried from point to point by the double reflection of Wang et al. 2008; that of a straight line
    upwards is (z, x, y), so that an outline keeps its sense. What twist a closed curve has left is spread over it.
    """
    if closed:
        tangents = np.roll(spine, -1, axis=0) - np.roll(spine, 1, axis=0)
    else:
        tangents = np.gradient(spine, axis=0)
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    seed = np.array([0.0, 0.0, 1.0]) if abs(tangents[0, 2]) < 0.8 else np.array([1.0, 0.0, 0.0])
    first = seed - (seed @ tangents[0]) * tangents[0]
    sides = [first / np.linalg.norm(first)]
    order = [*range(len(spine)), 0] if closed else [*range(len(spine))]
    for i, j in zip(order[:-1], order[1:], strict=True):
        step = spine[j] - spine[i]
        scale = 2 / (step @ step)
        side = sides[-1] - scale * (step @ sides[-1]) * step
        tangent = tangents[i] - scale * (step @ tangents[i]) * step
        across = tangents[j] - tangent
        if across @ across > 1e-12:
            side = side - 2 / (across @ across) * (across @ side) * across
        sides.append(side)
    axes = np.stack(sides[: len(spine)])
    others = np.cross(tangents, axes)
    if closed:
        twist = np.arctan2(sides[-1] @ others[0], sides[-1] @ axes[0])
        angle = -twist * np.arange(len(spine))[:, None] / len(spine)
        axes, others = (
            np.cos(angle) * axes + np.sin(angle) * others,
            np.cos(angle) * others - np.sin(angle) * axes,
        )
    return np.stack([axes, others, tangents], axis=-1)


def tube(spine: np.ndarray, sections: np.ndarray, closed: bool = False, inner: int = 2) -> Solid:
    """The solid of outlines that are carried along a curve.

    Args:
        spine: points (k, 3).
        sections: outlines (k, n, 2), counter-clockwise, one a point; a first or last one of no size is a tip.
        closed: whether the curve ends where it begins.
        inner: rings inside each flat end, so that it can be displaced as the sides can.

    Returns:
        The solid; as for `surface`.
    """
    frames = frames_along(spine, closed)
    rings = spine[:, None] + np.einsum("kij,knj->kni", frames[:, :, :2], sections)
    return surface(rings, closed, inner)


def surface(rings: np.ndarray, closed: bool = False, inner: int = 2) -> Solid:
    """The solid over rings of points.

    Args:
        rings: points (k, n, 3), counter-clockwise seen from the last ring's side; a first or last ring of no size is
            a tip.
        closed: whether the last ring is followed by the first.
        inner: rings inside each flat end. The ends must be star-shaped about the mean of their points.

    Returns:
        The solid. On its sides u runs around and v along; a flat end is seen from outside, scaled to fill the texture.
        Its cells are -1 on flat ends, as those of `data_gen.shapes.solids`.
    """
    count, around = rings.shape[:2]
    if closed:
        faces, uv, cells, _ = skin(rings, wrap=True)
        vertices = rings.reshape(-1, 3)
        return Solid(vertices, faces, uv, cells, signed_volume(vertices, faces))
    first, last = (_fan(rings[end], inner) for end in (0, -1))
    whole = np.concatenate([first[::-1], rings, last])
    faces, uv, cells, _ = skin(whole, wrap=False)
    along = cells[:, 0]
    sides = (along >= len(first)) & (along < len(first) + count - 1)
    uv = uv.copy()
    uv[sides, :, 1] = (uv[sides, :, 1] * (len(whole) - 1) - len(first)) / (count - 1)
    cells = np.stack([along - len(first), cells[:, 1]], axis=1)
    for which, ends, towards in ((0, along < len(first), -1.0), (1, along >= len(first) + count - 1, 1.0)):
        if ends.any():
            uv[ends] = _flat_coordinates(rings[-which], towards, whole.reshape(-1, 3)[faces[ends]])
            cells[ends] = (-1, which)
    vertices = whole.reshape(-1, 3)
    solid = Solid(vertices, faces, np.clip(uv, 0, 1), cells, signed_volume(vertices, faces))
    return collapsed(solid, (0, (len(whole) - 1) * around), around)  # the innermost ring of an end is one point


def _fan(ring: np.ndarray, inner: int) -> np.ndarray:
    """Rings (inner + 1, n, 3) from an end's outline to its middle, without the outline; none at a tip."""
    middle = ring.mean(axis=0)
    if np.abs(ring - middle).max() < 1e-9:
        return np.empty((0, *ring.shape))
    shares = 1 - np.arange(1, inner + 2) / (inner + 1)
    return middle + shares[:, None, None] * (ring - middle)


def _flat_coordinates(ring: np.ndarray, towards: float, points: np.ndarray) -> np.ndarray:
    """Texture coordinates (..., 2) of points of a flat end over a ring (n, 3)."""
    middle = ring.mean(axis=0)
    normal = np.cross(ring - middle, np.roll(ring, -1, axis=0) - middle).sum(axis=0) * towards
    first = ring[0] - middle
    second = np.cross(normal / max(np.linalg.norm(normal), 1e-12), first)
    axes = np.stack([first, second], axis=1) / max(np.linalg.norm(first), 1e-12)
    low, high = ((ring - middle) @ axes).min(axis=0), ((ring - middle) @ axes).max(axis=0)
    return ((points - middle) @ axes - low) / np.maximum(high - low, 1e-9)


def bar(start: np.ndarray, end: np.ndarray, radius: float, sides: int) -> Solid:
    """A straight bar between two points, of a regular section with that circumradius."""
    spine = np.stack([start, end])
    return tube(spine, np.tile(radius * ellipse(1.0, 1.0, sides), (2, 1, 1)), inner=0).creased(40 if sides < 6 else 65)
