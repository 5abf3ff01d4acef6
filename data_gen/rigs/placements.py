"""Camera positions of rigs: fixed, random, a circle, a spiral."""

from __future__ import annotations

import math

import numpy as np

from data_gen.rigs.rig import DEFAULT_DISTANCE, Array, Rig, aimed

__all__ = ["fixed", "orbit", "random", "spiral"]

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_SPIRAL_ANGLE = 20.0  # radians about the vertical axis from the horizon to the pole, as in SRN's renderer


def fixed(
    views: int,
    resolution: int,
    *,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
) -> Rig:
    """The same evenly spread poses for every object.

    Views with an even index (support) and with an odd index (query) are each a spherical Fibonacci spread over the
    elevations from -20 to 80 degrees, and their union is well spread, too: the second spread is half a step higher and
    rotated into the gaps of the first. Within each half, views are in farthest-first order, so the first few are well
    spread as well. Of 50 views, no two are closer than 15.6 degrees, and no two of a half closer than 29 degrees.

    The arguments are those of `make_rig`.
    """
    bottom, top = (math.sin(math.radians(elevation)) for elevation in (-20.0, 80.0))
    directions = np.empty((views, 3))
    for first in (0, 1):
        count = len(range(first, views, 2))
        if count:  # a golden spiral, uniform in area between the two heights
            heights = bottom + (top - bottom) * (np.arange(count) + 0.25 + 0.5 * first) / count
            azimuths = first * _GOLDEN_ANGLE / 2.0 + _GOLDEN_ANGLE * np.arange(count, dtype=np.float64)
            spread = _directions(heights, azimuths)
            directions[first::2] = spread[_farthest_first(spread)]
    return aimed(directions, resolution, distance, field_of_view)


def random(
    views: int,
    resolution: int,
    *,
    seed: int,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
    lowest: float = -90.0,
) -> Rig:
    """Cameras at random, uniformly in area over the sphere above an elevation.

    Elevations are at least `lowest` degrees (0 for the upper hemisphere); the other arguments are those of `make_rig`.
    """
    generator = np.random.default_rng(seed)
    heights = generator.uniform(math.sin(math.radians(lowest)), 1.0, views)
    azimuths = generator.uniform(0.0, 2.0 * math.pi, views)
    return aimed(_directions(heights, azimuths), resolution, distance, field_of_view)


def orbit(
    views: int,
    resolution: int,
    *,
    elevation: float = 20.0,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
) -> Rig:
    """Cameras evenly around the object at one height: a turntable.

    The first is in the direction of +z, all are `elevation` degrees above the horizon; the other arguments are those of
    `make_rig`.
    """
    azimuths = 2.0 * math.pi * np.arange(views) / views
    heights = np.full(views, math.sin(math.radians(elevation)))
    return aimed(_directions(heights, azimuths), resolution, distance, field_of_view)


def spiral(
    views: int,
    resolution: int,
    *,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
) -> Rig:
    """Cameras on an Archimedean spiral over the upper hemisphere, from the horizon to the pole.

    Elevations grow in equal steps to 90 degrees, while the azimuth turns by 20 radians, as in the renderings of
    SRN's test objects (Sitzmann et al. 2019); the arguments are those of `make_rig`.
    """
    steps = np.arange(views) / max(views - 1, 1)
    return aimed(
        _directions(np.sin(0.5 * math.pi * steps), -_SPIRAL_ANGLE * steps), resolution, distance, field_of_view
    )


def _directions(heights: Array, azimuths: Array) -> Array:
    """Unit vectors (view, 3) from y coordinates and angles about y that start at +z and turn towards +x."""
    across = np.sqrt(np.clip(1.0 - heights**2, 0.0, None))
    return np.stack((across * np.sin(azimuths), heights, across * np.cos(azimuths)), axis=-1)


def _farthest_first(directions: Array) -> list[int]:
    """An order in which each direction is the one farthest from all before it; the first stays first."""
    order = [0]
    nearness = directions @ directions[0]
    while len(order) < len(directions):
        following = int(np.argmin(np.where(np.isin(np.arange(len(directions)), order), np.inf, nearness.round(9))))
        order.append(following)
        nearness = np.maximum(nearness, directions @ directions[following])
    return order
