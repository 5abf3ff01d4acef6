"""Named camera configurations: those of the paper's two data sets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from data_gen.rig import DEFAULT_DISTANCE, Rig
from data_gen.rigs import fixed, random

__all__ = ["RIG_PRESETS", "RigPreset", "preset"]


@dataclass(frozen=True)
class RigPreset:
    """Where cameras stand, what they see, and how many pixels they have.

    Attributes:
        kind: the same poses for every object, or others for each, anywhere on the sphere.
        views: cameras an object.
        resolution: pixels along a side.
        distance: of the cameras from the origin, in world units.
        field_of_view: full angle in degrees; None fits the unit sphere.
    """

    kind: Literal["fixed", "random"]
    views: int
    resolution: int
    distance: float = DEFAULT_DISTANCE
    field_of_view: float | None = None


_BLENDER_FIELD_OF_VIEW = math.degrees(2.0 * math.atan(36.0 / 2.0 / 50.0))  # a lens of 50 mm before a film of 36 mm

RIG_PRESETS: dict[str, RigPreset] = {
    "paper-128": RigPreset("random", 50, 128, distance=4.0, field_of_view=_BLENDER_FIELD_OF_VIEW),
    "paper-200": RigPreset("fixed", 50, 200),
}
"""The cameras of the paper's two data sets.

`paper-128` follows the ShapeNet renders of "Learned Initializations" (Tancik et al. 2021), the paper's first data set:
at random all over the sphere, at distance 4 (its loaders sample rays from 2 to 6), with Blender's field of view; the
unit sphere spans 72 % of the picture. `paper-200` is the paper's second: the same 50 poses for every object.
"""


def preset(name: str, *, seed: int = 0) -> Rig:
    """The cameras of a named configuration.

    Args:
        name: A name in RIG_PRESETS.
        seed: Seed of the presets that place cameras at random.

    Returns:
        The rig.

    Raises:
        ValueError: If no preset has that name.
    """
    if name not in RIG_PRESETS:
        raise ValueError(f"rig preset: expected one of {', '.join(RIG_PRESETS)}, received {name!r}")
    chosen = RIG_PRESETS[name]
    lens = {"distance": chosen.distance, "field_of_view": chosen.field_of_view}
    if chosen.kind == "fixed":
        return fixed(chosen.views, chosen.resolution, **lens)
    return random(chosen.views, chosen.resolution, seed=seed, **lens)
