"""Lights around an object, the same for every renderer.

All lights but the headlight are fixed to the WORLD, so a point of the object has the same diffuse colour in every view.
Directions are unit vectors from the object TOWARDS the light, y up; colours are linear RGB, in units in which a white
Lambertian surface facing a light of colour 1 reflects 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["LIGHTING_PRESETS", "MAX_LIGHTS", "Light", "Lighting", "resolve_lighting"]

Vector = tuple[float, float, float]

MAX_LIGHTS = 4
"""Most directional lights of a Lighting."""

LIGHTING_PRESETS = ("studio", "headlight", "random")
"""Names for `resolve_lighting`."""


@dataclass(frozen=True)
class Light:
    """A directional light.

    Attributes:
        direction: unit vector towards the light, in world axes, or in OpenCV camera axes for a headlight.
        colour: linear RGB; with 1, a white surface facing the light is white.
    """

    direction: Vector
    colour: Vector


@dataclass(frozen=True)
class Lighting:
    """Directional lights and an ambient light that changes from sky to ground.

    Attributes:
        lights: up to MAX_LIGHTS directional lights.
        sky: ambient light on a surface facing up, linear RGB.
        ground: ambient light on a surface facing down, linear RGB.
        follows_camera: whether the lights' directions are in OpenCV camera axes instead of world axes.
        is_constant: whether many objects share it, so that a renderer may compile it into a shader.

    Raises:
        ValueError: if there are too many lights, a direction is not a unit vector or a colour is negative.
    """

    lights: tuple[Light, ...]
    sky: Vector
    ground: Vector
    follows_camera: bool = False
    is_constant: bool = False

    def __post_init__(self) -> None:
        if len(self.lights) > MAX_LIGHTS:
            raise ValueError(f"lights: expected at most {MAX_LIGHTS}, got {len(self.lights)}")
        for light in self.lights:
            length = math.hypot(*light.direction)
            if not abs(length - 1.0) < 1e-6:
                raise ValueError(f"direction: expected a unit vector, got {light.direction} of length {length:g}")
        for colour in (self.sky, self.ground, *(light.colour for light in self.lights)):
            if len(colour) != 3 or not all(math.isfinite(value) and value >= 0.0 for value in colour):
                raise ValueError(f"colour: expected three numbers from 0 on, got {colour}")

    def directions(self, world_from_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Unit vectors towards the lights in world axes.

        Args:
            world_from_camera: the pose `(4, 4)` of the camera, OpenCV axes.

        Returns:
            Directions `(light, 3)`.
        """
        directions = np.array([light.direction for light in self.lights], dtype=np.float64).reshape(-1, 3)
        return directions @ world_from_camera[:3, :3].T if self.follows_camera else directions

    @property
    def colours(self) -> npt.NDArray[np.float64]:
        """Colours of the lights `(light, 3)`, linear RGB."""
        return np.array([light.colour for light in self.lights], dtype=np.float64).reshape(-1, 3)


def resolve_lighting(lighting: str | Lighting, *, seed: int = 0) -> Lighting:
    """The lighting with a name, or the given lighting.

    Args:
        lighting: `studio`, `headlight`, `random`, or a Lighting, which is returned unchanged.
        seed: seed of `random`; the same seed gives the same lights.

    Returns:
        The lighting.

    Raises:
        ValueError: if no preset has that name.
    """
    if isinstance(lighting, Lighting):
        return lighting
    if lighting == "studio":
        return _STUDIO
    if lighting == "headlight":
        return _HEADLIGHT
    if lighting == "random":
        return _random(seed)
    raise ValueError(f"lighting: expected one of {', '.join(LIGHTING_PRESETS)} or a Lighting, got {lighting!r}")


def _direction(azimuth: float, elevation: float) -> Vector:
    """Unit vector at angles in degrees; azimuth starts at +z and turns towards +x."""
    across = math.cos(math.radians(elevation))
    return (
        across * math.sin(math.radians(azimuth)),
        math.sin(math.radians(elevation)),
        across * math.cos(math.radians(azimuth)),
    )


def _grey(value: float, warmth: float = 0.0) -> Vector:
    """A grey of one brightness, a little warmer (positive) or cooler (negative)."""
    return (value * (1.0 + warmth), value, value * (1.0 - warmth))


def _random(seed: int) -> Lighting:
    """Three random lights on the upper hemisphere and a random ambient light, together as bright as the studio."""
    generator = np.random.default_rng(seed)
    lights = []
    for strength in (0.5, 0.22, 0.12):
        azimuth, height = generator.uniform(0.0, 360.0), generator.uniform(0.1, 0.95)
        brightness, warmth = strength * generator.uniform(0.75, 1.15), generator.uniform(-0.08, 0.08)
        lights.append(Light(_direction(azimuth, math.degrees(math.asin(height))), _grey(brightness, warmth)))
    ambient = generator.uniform(0.25, 0.36)
    return Lighting(tuple(lights), sky=_grey(ambient), ground=_grey(ambient * generator.uniform(0.6, 0.9)))


# Key, fill and rim. An upright wall reflects 0.69 of its colour when it faces +z, 0.58 at +x, 0.50 at -x, 0.44 at -z; a
# floor 0.91 and a ceiling 0.27: every side differs from its neighbour, none is black.
_STUDIO = Lighting(
    lights=(
        Light(_direction(35.0, 45.0), _grey(0.54)),
        Light(_direction(-75.0, 20.0), _grey(0.18)),
        Light(_direction(165.0, 30.0), _grey(0.13)),
    ),
    sky=_grey(0.40),
    ground=_grey(0.27),
    is_constant=True,
)

_HEADLIGHT = Lighting(
    lights=(Light((0.0, 0.0, -1.0), _grey(0.70)),), sky=_grey(0.25), ground=_grey(0.25), follows_camera=True
)
