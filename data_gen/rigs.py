"""Where the cameras of a generated object stand: `fixed`, at `random`, or in an `orbit`. Conventions: `data_gen.rig`.

Numbers that make no sense are a ValueError that names them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from data_gen.rig import DEFAULT_DISTANCE, OBJECT_RADIUS, Rig, fitting_field_of_view, look_at_origin

__all__ = ["fixed", "orbit", "random"]

Array = npt.NDArray[np.float64]

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_HALF_TURN = _GOLDEN_ANGLE / 2.0


def fixed(
    views: int = 50,
    resolution: int | tuple[int, int] = 128,
    *,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
    lowest: float = -20.0,
    highest: float = 80.0,
) -> Rig:
    """The same well spread poses for every object.

    Views with an even index (support) and with an odd index (query) are each a spherical Fibonacci spread over the band
    of elevations, and their union is well spread too: the second spread stands half a step higher and is turned into
    the gaps of the first. Within each half, views come in farthest-first order, so the first few are well spread as
    well. Of 50 views, no two are nearer than 15.6 degrees, and no two of a half nearer than 29 degrees.

    Args:
        views: Number of views.
        resolution: Pixels, one number for a square image or (width, height).
        distance: Distance of the cameras from the origin in world units.
        field_of_view: Full angle across the smaller side in degrees; None fits the unit sphere.
        lowest: Lowest elevation in degrees.
        highest: Highest elevation in degrees.

    Returns:
        A rig of ``views`` cameras.
    """
    _check_views(views)
    band = _height_band(lowest, highest)
    directions = np.empty((views, 3))
    for first in (0, 1):
        count = len(range(first, views, 2))
        if count:
            spread = _fibonacci_band(count, *band, level=0.25 + 0.5 * first, turn=first * _HALF_TURN)
            directions[first::2] = spread[_farthest_first(spread)]
    return _rig(directions, resolution, distance, field_of_view)


def random(
    views: int = 50,
    resolution: int | tuple[int, int] = 128,
    *,
    seed: int,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
    lowest: float = -90.0,
    highest: float = 90.0,
) -> Rig:
    """Cameras at random, uniformly in area over a band of elevations: the whole sphere, or the upper half of it.

    Args:
        views: Number of views.
        resolution: Pixels, one number for a square image or (width, height).
        seed: Seed of the random numbers; the same seed gives the same poses.
        distance: Distance of the cameras from the origin in world units.
        field_of_view: Full angle across the smaller side in degrees; None fits the unit sphere.
        lowest: Lowest elevation in degrees; 0 for the upper hemisphere.
        highest: Highest elevation in degrees.

    Returns:
        A rig of ``views`` cameras.
    """
    _check_views(views)
    generator = np.random.default_rng(seed)
    heights = generator.uniform(*_height_band(lowest, highest), views)
    azimuths = generator.uniform(0.0, 2.0 * math.pi, views)
    return _rig(_directions(heights, azimuths), resolution, distance, field_of_view)


def orbit(
    views: int = 60,
    resolution: int | tuple[int, int] = 128,
    *,
    elevation: float = 20.0,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
) -> Rig:
    """Cameras evenly around the object at one height: a turntable.

    Args:
        views: Number of views; the one after the last would be the first again.
        resolution: Pixels, one number for a square image or (width, height).
        elevation: Height of the cameras over the horizon in degrees.
        distance: Distance of the cameras from the origin in world units.
        field_of_view: Full angle across the smaller side in degrees; None fits the unit sphere.

    Returns:
        A rig of ``views`` cameras, the first in the direction of +z.

    Raises:
        ValueError: If the number of views, elevation, distance or resolution make no sense.
    """
    _check_views(views)
    if not -90.0 <= elevation <= 90.0:
        raise ValueError(f"elevation: expected -90 to 90 degrees, received {elevation}")
    azimuths = 2.0 * math.pi * np.arange(views) / views
    heights = np.full(views, math.sin(math.radians(elevation)))
    return _rig(_directions(heights, azimuths), resolution, distance, field_of_view)


def _check_views(views: int) -> None:
    if views < 1:
        raise ValueError(f"views: expected at least 1, received {views}")


def _directions(heights: Array, azimuths: Array) -> Array:
    """Unit vectors (view, 3) from y coordinates and angles about y that start at +z and turn towards +x."""
    across = np.sqrt(np.clip(1.0 - heights**2, 0.0, None))
    return np.stack((across * np.sin(azimuths), heights, across * np.cos(azimuths)), axis=-1)


def _height_band(lowest: float, highest: float) -> tuple[float, float]:
    """The y coordinates on the unit sphere of two elevations in degrees."""
    if not -90.0 <= lowest < highest <= 90.0:
        raise ValueError(f"lowest, highest: expected -90 <= lowest < highest <= 90, received {lowest} and {highest}")
    return math.sin(math.radians(lowest)), math.sin(math.radians(highest))


def _fibonacci_band(count: int, bottom: float, top: float, *, level: float, turn: float) -> Array:
    """Directions (count, 3) on a golden spiral, uniform in area between two heights."""
    heights = bottom + (top - bottom) * (np.arange(count) + level) / count
    return _directions(heights, turn + _GOLDEN_ANGLE * np.arange(count, dtype=np.float64))


def _farthest_first(directions: Array) -> list[int]:
    """An order in which each direction is the one farthest from all before it; the first stays first."""
    order = [0]
    nearness = directions @ directions[0]
    while len(order) < len(directions):
        following = int(np.argmin(np.where(np.isin(np.arange(len(directions)), order), np.inf, nearness.round(9))))
        order.append(following)
        nearness = np.maximum(nearness, directions @ directions[following])
    return order


def _rig(directions: Array, resolution: int | tuple[int, int], distance: float, field_of_view: float | None) -> Rig:
    size: Any = resolution if isinstance(resolution, tuple) else (resolution, resolution)
    width, height = int(size[0]), int(size[1])
    if width < 1 or height < 1:
        raise ValueError(f"resolution: expected at least 1 pixel, received {resolution}")
    fitting = fitting_field_of_view(distance)
    angle = fitting if field_of_view is None else field_of_view
    if not 0.0 < angle < 180.0:
        raise ValueError(f"field_of_view: expected more than 0 and less than 180 degrees, received {field_of_view}")
    focal = min(width, height) / 2.0 / math.tan(math.radians(angle) / 2.0)
    intrinsics = np.array(
        [[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]], dtype=np.float64
    )
    near, far = distance - OBJECT_RADIUS, distance + OBJECT_RADIUS
    return Rig(look_at_origin(directions * distance), intrinsics, width, height, near, far)
