"""Camera rigs: posed cameras of one size that look at a generated object; fixed, random, orbit, spiral, or by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from data_gen.rigs.placements import fixed, orbit, random, spiral
from data_gen.rigs.rig import DEFAULT_DISTANCE, OBJECT_RADIUS, Rig, fitting_field_of_view, look_at_origin

__all__ = [
    "DEFAULT_DISTANCE",
    "OBJECT_RADIUS",
    "RIGS",
    "RIG_PRESETS",
    "Rig",
    "RigPreset",
    "fitting_field_of_view",
    "fixed",
    "look_at_origin",
    "make_rig",
    "orbit",
    "random",
    "spiral",
]

_BLENDER_FIELD_OF_VIEW = math.degrees(2.0 * math.atan(36.0 / 2.0 / 50.0))  # a 50 mm lens and a 36 mm sensor
_SRN_FIELD_OF_VIEW = math.degrees(2.0 * math.atan(128.0 / 2.0 / 131.25))  # a focal length of 131.25 pixels at 128


@dataclass(frozen=True)
class RigPreset:
    """Named settings of a rig.

    Attributes:
        kind: the same poses for every object, random ones for each, anywhere on the sphere, or a spiral.
        views: cameras per object.
        resolution: pixels along a side.
        distance: of the cameras from the origin, in world units.
        field_of_view: full angle in degrees; None fits the unit sphere.
    """

    kind: Literal["fixed", "random", "spiral"]
    views: int
    resolution: int
    distance: float = DEFAULT_DISTANCE
    field_of_view: float | None = None


RIG_PRESETS: dict[str, RigPreset] = {
    "paper-128": RigPreset("random", 50, 128, distance=4.0, field_of_view=_BLENDER_FIELD_OF_VIEW),
    "paper-200": RigPreset("fixed", 50, 200, distance=4.0, field_of_view=_BLENDER_FIELD_OF_VIEW),
    "srn": RigPreset("spiral", 251, 128, distance=2.6, field_of_view=_SRN_FIELD_OF_VIEW),
}
"""The cameras of the paper's two data sets, and those of the test objects of SRN.

`paper-128` follows the ShapeNet renders of "Learned Initializations" (Tancik et al. 2021), the paper's first data set:
random poses on the whole sphere, at distance 4 (its loaders sample rays from 2 to 6), with Blender's field of view; the
unit sphere spans 72 % of the picture. `paper-200` is the paper's second: the same 50 poses for every object. The
paper does not state the poses; its loader assumes a focal length of 277.77 pixels, which is the same field of view,
near 2 and far 6.

`srn` follows the test cars of "Scene Representation Networks" (Sitzmann et al. 2019), on which pixelNeRF and Splatter
Image are compared: 251 views of 128x128 on an Archimedean spiral (`spiral`), 1.3 from the centre of a car whose sphere
has a radius of a half, with a focal length of 131.25 pixels.
"""

RIGS = ("fixed", "random", "hemisphere", "orbit", "spiral", *RIG_PRESETS)
"""Names of camera rigs."""


def make_rig(
    name: str,
    views: int,
    resolution: int,
    *,
    seed: int = 0,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
) -> Rig:
    """The cameras of a named rig.

    Args:
        name: one of RIGS; a preset only gives the kind, its numbers are arguments here.
        views: number of views.
        resolution: pixels along a side.
        seed: seed of random rigs.
        distance: distance of the cameras from the origin in world units.
        field_of_view: full angle in degrees; None fits the unit sphere.

    Returns:
        The rig.

    Raises:
        ValueError: if the name is unknown or a number is invalid.
    """
    kind = RIG_PRESETS[name].kind if name in RIG_PRESETS else name
    lens = {"distance": distance, "field_of_view": field_of_view}
    if kind == "fixed":
        return fixed(views, resolution, **lens)
    if kind == "orbit":
        return orbit(views, resolution, **lens)
    if kind == "spiral":
        return spiral(views, resolution, **lens)
    if kind not in RIGS:
        raise ValueError(f"rig: expected one of {', '.join(RIGS)}, got {name!r}")
    return random(views, resolution, seed=seed, lowest=-90.0 if kind == "random" else 0.0, **lens)
