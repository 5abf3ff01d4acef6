"""The solids that parts are made of, each a loft, a lathe or a sweep. Axes and volumes as in `solids`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_gen.shapes.profiles import ellipse, rectangle, rounded_rectangle
from data_gen.shapes.solids import Solid, lathe, loft, sweep

__all__ = ["ball", "box", "cone", "cushion", "cylinder", "panel", "post", "rod", "tapered", "torus", "tube"]

Point = Sequence[float] | np.ndarray


def box(width: float, height: float, depth: float, radius: float = 0.0, steps: int = 1) -> Solid:
    """Box centred on the origin with extents (width, height, depth) along (x, y, z).

    Args:
        width: extent along x.
        height: extent along y.
        depth: extent along z.
        radius: radius of the upright edges and size of the bevel above and below; 0 for a plain box.
        steps: edges that round off each upright edge.

    Returns:
        The solid.
    """
    if radius <= 0:
        return tapered((width, depth), (width, depth), height)
    radius = min(radius, 0.45 * min(width, height, depth))
    outer = rounded_rectangle(depth, width, radius, steps)
    inner = rounded_rectangle(depth - radius, width - radius, radius / 2, steps)
    half = height / 2
    return loft([inner, outer, outer, inner], [-half, -half + radius / 2, half - radius / 2, half], "y").creased(50)


def tapered(
    bottom: tuple[float, float], top: tuple[float, float], height: float, shift: tuple[float, float] = (0, 0)
) -> Solid:
    """Frustum over two rectangles, centred on y = 0.

    Args:
        bottom: extents (x, z) of the lower end.
        top: extents (x, z) of the upper end.
        height: extent along y.
        shift: offset (x, z) of the upper end's centre from the lower end's.

    Returns:
        The solid; an upright bar or a leg where it is tall, a slab where it is flat.
    """
    outlines = []
    for (x, z), (dx, dz) in ((bottom, (0, 0)), (top, shift)):
        outlines.append(np.array([(-z, -x), (z, -x), (z, x), (-z, x)]) / 2 + (dz, dx))
    return loft(outlines, [-height / 2, height / 2], "y").creased(20)


def cylinder(radius: float, height: float, segments: int = 16) -> Solid:
    """Upright cylinder centred on the origin: a prism over a regular polygon inscribed in the circle."""
    return cone(radius, radius, height, segments)


def cone(bottom: float, top: float, height: float, segments: int = 16) -> Solid:
    """Upright frustum centred on the origin with the radii of its lower and upper ends, either of which may be 0."""
    return lathe([(bottom, -height / 2), (top, height / 2)], segments)


def ball(radius_x: float, radius_y: float, radius_z: float, segments: int = 14, rings: int = 8) -> Solid:
    """Ellipsoid centred on the origin, inscribed in the smooth one."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    radii = np.cos(angles)
    radii[[0, -1]] = 0
    return lathe(np.stack([radii, np.sin(angles)], 1), segments).scaled(radius_x, radius_y, radius_z).creased(60)


def torus(major: float, minor: float, segments: int = 20, sides: int = 8) -> Solid:
    """Ring about the y axis: a regular polygon of circumradius `minor` carried around a circle of radius `major`."""
    angles = np.arange(sides) * (2 * np.pi / sides)
    profile = np.stack([major + minor * np.cos(angles), minor * np.sin(angles)], 1)
    return lathe(profile, segments, ring=True).creased(60)


def post(bottom: Point, top: Point, bottom_size: float, top_size: float, sides: int = 4) -> Solid:
    """Upright member between two points, its ends level.

    Args:
        bottom: centre (x, y, z) of the lower end.
        top: centre of the upper end, higher than the lower.
        bottom_size: width of the lower end: of the square, or across the polygon's corners.
        top_size: width of the upper end.
        sides: 4 for a square section parallel to the axes, more for a polygon.

    Returns:
        The solid, straight or leaning.
    """
    outlines = []
    for centre, size in ((bottom, bottom_size), (top, top_size)):
        outline = rectangle(size, size) if sides == 4 else ellipse(size / 2, size / 2, sides)
        outlines.append(outline + (centre[2], centre[0]))
    return loft(outlines, [bottom[1], top[1]], "y").creased(20 if sides == 4 else 60)


def rod(start: Point, end: Point, width: float, height: float | None = None, sides: int = 6) -> Solid:
    """Straight bar between two points.

    Args:
        start: centre (x, y, z) of one end.
        end: centre of the other.
        width: sideways extent.
        height: extent across it; the width if absent.
        sides: 4 for a rectangle, more for a polygon.

    Returns:
        The solid.
    """
    return tube([start, end], width, height, sides)


def tube(path: Sequence[Point] | np.ndarray, width: float, height: float | None = None, sides: int = 6) -> Solid:
    """Bar along a polyline with mitred corners, its section upright or, where it starts upright, facing the front.

    Args:
        path: points (k, 3).
        width: sideways extent.
        height: extent across it; the width if absent.
        sides: 4 for a rectangle, more for a polygon.

    Returns:
        The solid.
    """
    points = np.asarray(path, dtype=float)
    first = points[1] - points[0]
    steep = abs(first[1]) > 0.9 * np.linalg.norm(first)
    height = width if height is None else height
    outline = rectangle(width, height) if sides == 4 else ellipse(width / 2, height / 2, sides)
    return sweep(points, outline, up=(0, 0, 1) if steep else (0, 1, 0)).creased(30 if sides == 4 else 65)


def panel(
    bottom: float, top: float, height: float, thickness: float, bow: float, lean: float, roundness: float = 0.0
) -> Solid:
    """Upright plate, curved around its user, standing on y = 0 with its middle front edge at z = 0.

    Args:
        bottom: width at the foot.
        top: width at the head.
        height: extent along y.
        thickness: extent along z.
        bow: how far the sides reach forward of the middle.
        lean: how far the head lies behind the foot.
        roundness: share of the width by which the head's corners are rounded off, in [0, 0.9].

    Returns:
        The solid.
    """
    levels = np.array([0, 0.35, 0.7, 0.86, 0.95, 1.0])
    across = np.linspace(-1, 1, 7)
    outlines = []
    for level in levels:
        width = bottom + (top - bottom) * level
        width *= 1 - roundness * (1 - np.sqrt(max(0.0, 1 - (max(0.0, level - 0.7) / 0.3) ** 2)))
        x = across * width / 2
        front = bow * (2 * x / max(bottom, top)) ** 2 - lean * level
        outer = np.stack([front, x], 1)
        outlines.append(np.concatenate([outer, (outer - [thickness, 0])[::-1]]))
    return loft(outlines, levels * height, "y").creased(50)


def cushion(width: float, height: float, depth: float, softness: float = 0.5) -> Solid:
    """Box centred on the origin with swelling sides, as upholstery has.

    Args:
        width: extent along x.
        height: extent along y.
        depth: extent along z.
        softness: 0 for nearly a box, 1 for a pillow.

    Returns:
        The solid.
    """
    radius = (0.06 + 0.16 * softness) * min(width, depth)
    inset = min(0.9 * radius, 0.5 * height + 0.1 * radius)
    outlines, heights = [], []
    for share, level in ((1.0, -0.5), (0.35, -0.4), (0.0, -0.15), (0.0, 0.15), (0.35, 0.4), (1.0, 0.5)):
        shrink = 2 * inset * share
        outlines.append(rounded_rectangle(depth - shrink, width - shrink, radius, 2))
        heights.append(level * height)
    return loft(outlines, heights, "y").creased(60)
