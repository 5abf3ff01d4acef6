"""Random cross-sections: closed outlines of one number of corners, so that any two of them can be joined."""

from __future__ import annotations

import numpy as np

from data_gen.shapes.choices import pick
from data_gen.shapes.profiles import ellipse, polygon_area, rectangle, rounded_rectangle, superellipse
from data_gen.shapes.random.tubes import subdivided

__all__ = ["OUTLINE_CORNERS", "blob", "cross", "outline", "star"]

OUTLINE_CORNERS = 24
"""Corners of an outline."""

_SHARES = {
    "circle": 3.0,
    "rectangle": 3.0,
    "rounded": 1.5,
    "polygon": 1.5,
    "blob": 1.0,
    "superellipse": 0.7,
    "star": 0.5,
    "cross": 0.5,
    "half": 0.4,
}


def blob(rng: np.random.Generator) -> np.ndarray:
    """A smooth outline (OUTLINE_CORNERS, 2) in polar coordinates, whose radius varies by four cosines."""
    angles = np.arange(OUTLINE_CORNERS) * (2 * np.pi / OUTLINE_CORNERS)
    radius = np.ones(OUTLINE_CORNERS)
    for frequency in range(1, 5):
        radius += rng.uniform(0, 0.28 / frequency) * np.cos(frequency * angles + rng.uniform(0, 2 * np.pi))
    return radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def star(points: int, depth: float) -> np.ndarray:
    """A star (OUTLINE_CORNERS, 2) of some points, whose inner corners lie at `depth` of the outer ones' radius."""
    corners = ellipse(1.0, 1.0, 2 * points)
    corners[1::2] *= depth
    return subdivided(corners, OUTLINE_CORNERS)


def cross(arm: float) -> np.ndarray:
    """A plus sign (OUTLINE_CORNERS, 2) in the square of side 2, its arms of half-width `arm`."""
    quarter = np.array([(1, -arm), (1, arm), (arm, arm)])
    corners = [quarter, quarter[:, ::-1] * (-1, 1), -quarter, quarter[:, ::-1] * (1, -1)]
    return subdivided(np.concatenate(corners), OUTLINE_CORNERS)


def outline(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """An outline about the origin that fills the square of side 2, and the crease angle in degrees that suits it.

    Returns:
        Corners (OUTLINE_CORNERS, 2), counter-clockwise, star-shaped about their mean, and the angle.
    """
    kind, crease = pick(rng, _SHARES), 40.0
    if kind == "circle":
        corners = ellipse(1.0, 1.0, OUTLINE_CORNERS)
    elif kind == "rectangle":
        corners = subdivided(rectangle(2.0, 2.0), OUTLINE_CORNERS)
    elif kind == "rounded":
        corners, crease = subdivided(rounded_rectangle(2.0, 2.0, rng.uniform(0.15, 0.8), 3), OUTLINE_CORNERS), 50.0
    elif kind == "polygon":
        corners = subdivided(ellipse(1.0, 1.0, int(rng.choice([3, 5, 6, 8]))), OUTLINE_CORNERS)
    elif kind == "blob":
        corners, crease = blob(rng), 60.0
    elif kind == "superellipse":
        corners, crease = superellipse(2.0, 2.0, rng.uniform(0.7, 5.0), OUTLINE_CORNERS), 50.0
    elif kind == "star":
        corners = star(int(rng.integers(4, 9)), rng.uniform(0.45, 0.8))
    elif kind == "cross":
        corners = cross(rng.uniform(0.25, 0.6))
    else:
        angles = np.linspace(0, np.pi, 9)
        corners = subdivided(np.stack([np.cos(angles), np.sin(angles) - 0.4], axis=1), OUTLINE_CORNERS)
    corners = corners - corners.mean(axis=0)
    assert polygon_area(corners) > 0
    return corners / np.abs(corners).max(axis=0), crease
