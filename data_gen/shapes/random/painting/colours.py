"""Random colours: loud ones, and those of real materials."""

from __future__ import annotations

import colorsys

import numpy as np

from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Colour

__all__ = ["MATERIALS", "loud", "natural", "near", "random_colour"]

MATERIALS: dict[str, Colour] = {
    "oak": (176, 138, 92),
    "walnut": (94, 66, 46),
    "pine": (214, 178, 124),
    "mahogany": (118, 54, 38),
    "brick": (156, 78, 58),
    "terracotta": (196, 108, 72),
    "sand": (208, 188, 148),
    "clay": (150, 110, 86),
    "limestone": (206, 198, 180),
    "slate": (78, 84, 92),
    "granite": (128, 124, 122),
    "concrete": (164, 162, 156),
    "asphalt": (58, 58, 60),
    "steel": (150, 154, 160),
    "brass": (188, 152, 78),
    "copper": (178, 104, 70),
    "gold": (206, 166, 70),
    "rust": (128, 70, 40),
    "ivory": (232, 224, 200),
    "bone": (222, 208, 178),
    "porcelain": (240, 240, 236),
    "leather": (112, 72, 44),
    "black rubber": (34, 34, 36),
    "moss": (96, 108, 54),
    "leaf": (72, 120, 54),
    "denim": (64, 86, 124),
    "skin": (206, 156, 126),
    "paper": (244, 240, 230),
    "white paint": (238, 238, 238),
    "signal red": (176, 32, 36),
    "safety yellow": (232, 176, 30),
    "tractor green": (44, 100, 56),
    "sky blue": (96, 156, 206),
    "navy": (32, 42, 78),
}
"""Colours of materials and paints, sRGB, by eye."""


def near(rng: np.random.Generator, colour: Colour, spread: float) -> Colour:
    """A colour near another one, each channel moved by at most `spread` and all of them by as much again."""
    moved = np.array(colour) + rng.uniform(-spread, spread, 3) + rng.uniform(-spread, spread)
    red, green, blue = (int(channel) for channel in np.clip(np.round(moved), 0, 255))
    return red, green, blue


def natural(rng: np.random.Generator) -> Colour:
    """A colour near that of one of `MATERIALS`."""
    return near(rng, one_of(rng, list(MATERIALS.values())), 14)


def loud(rng: np.random.Generator) -> Colour:
    """A saturated colour of any hue."""
    rgb = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.55, 1.0), rng.uniform(0.45, 1.0))
    red, green, blue = (round(255 * channel) for channel in rgb)
    return red, green, blue


def random_colour(rng: np.random.Generator) -> Colour:
    """A natural colour in half of all cases, else a loud one or one of the whole cube."""
    draw = rng.random()
    if draw < 0.5:
        return natural(rng)
    if draw < 0.8:
        return loud(rng)
    red, green, blue = (int(channel) for channel in rng.integers(0, 256, 3))
    return red, green, blue
