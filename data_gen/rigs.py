"""Camera rigs: posed cameras of one size that look at a generated object; fixed, random, orbit, spiral, or by name.

Conventions: OpenCV camera axes (x right, y down, z forward), a world with y up, `world_from_camera` poses, intrinsics
in pixels with INTEGER pixel centres, so a centred principal point is `((W - 1) / 2, (H - 1) / 2)`. Objects are
expected inside the sphere of radius 1 around the origin, at which every camera looks.

A rig is numpy, and `Rig.cameras` makes Kornia cameras of it: worker processes, which import everything else of a rig,
take 0.7 s of processor time to start, and importing torch and Kornia would add 1.4 s to each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import torch
    from kornia.geometry.camera import PinholeCamera

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

Array = npt.NDArray[np.float64]

OBJECT_RADIUS = 1.0
"""Radius of the sphere around the origin that holds every normalised object, in world units."""

DEFAULT_DISTANCE = 3.0
"""Distance of the cameras from the origin, in world units."""

_MARGIN = 1.04
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_BLENDER_FIELD_OF_VIEW = math.degrees(2.0 * math.atan(36.0 / 2.0 / 50.0))  # a lens of 50 mm before a film of 36 mm
_SRN_FIELD_OF_VIEW = math.degrees(2.0 * math.atan(128.0 / 2.0 / 131.25))  # a focal length of 131.25 of 128 pixels
_SPIRAL_ANGLE = 20.0  # radians about the vertical axis from the horizon to the pole, as SRN's renderer has it


@dataclass(frozen=True)
class RigPreset:
    """Named settings of a rig.

    Attributes:
        kind: the same poses for every object, random ones for each, anywhere on the sphere, or a spiral.
        views: cameras an object.
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
at random all over the sphere, at distance 4 (its loaders sample rays from 2 to 6), with Blender's field of view; the
unit sphere spans 72 % of the picture. `paper-200` is the paper's second: the same 50 poses for every object. The
paper does not say where they stand; its loader assumes a focal length of 277.77 pixels, which is the same field of
view, near 2 and far 6.

`srn` follows the test cars of "Scene Representation Networks" (Sitzmann et al. 2019), by which pixelNeRF and Splatter
Image are compared: 251 views of 128x128 on an Archimedean spiral (`spiral`), 1.3 from the centre of a car whose sphere
has a radius of a half, with a focal length of 131.25 pixels.
"""

RIGS = ("fixed", "random", "hemisphere", "orbit", "spiral", *RIG_PRESETS)
"""Names of camera rigs."""


@dataclass(frozen=True)
class Rig:
    """Posed cameras of one size.

    Attributes:
        world_from_camera: camera poses `(view, 4, 4)`, OpenCV axes, in world units.
        intrinsics: pinhole matrices `(view, 3, 3)` in pixels, integer pixel centres. One `(3, 3)` is accepted and
            repeated for every view.
        width: image width in pixels.
        height: image height in pixels.
        near: distance along a ray before which there is no object, in world units.
        far: distance along a ray after which there is no object, in world units.

    Raises:
        ValueError: if a shape is wrong, a number is not finite, a pose is not a rigid motion, or near and far are out
            of order.
    """

    world_from_camera: Array
    intrinsics: Array
    width: int
    height: int
    near: float
    far: float

    def __post_init__(self) -> None:
        poses = np.ascontiguousarray(self.world_from_camera, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
            raise ValueError(f"world_from_camera: expected shape (view, 4, 4) with view >= 1, received {poses.shape}")
        intrinsics = np.asarray(self.intrinsics, dtype=np.float64)
        if intrinsics.shape not in {(3, 3), (len(poses), 3, 3)}:
            raise ValueError(f"intrinsics: expected shape (3, 3) or ({len(poses)}, 3, 3), received {intrinsics.shape}")
        intrinsics = np.array(np.broadcast_to(intrinsics, (len(poses), 3, 3)))
        if not (np.isfinite(poses).all() and np.isfinite(intrinsics).all()):
            raise ValueError("world_from_camera, intrinsics: expected finite numbers, received NaN or infinity")
        rotations = poses[:, :3, :3]
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max()
        if error > 1e-6 or np.linalg.det(rotations).min() < 0:
            raise ValueError(
                "world_from_camera: expected rotations without scale or mirroring, received "
                f"|R R^T - 1| up to {error:.2g} and determinants from {np.linalg.det(rotations).min():.3g}"
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width, height: expected at least 1 pixel, received {self.width} x {self.height}")
        if not 0 < self.near < self.far:
            raise ValueError(f"near, far: expected 0 < near < far, received {self.near} and {self.far}")
        poses.flags.writeable = False
        intrinsics.flags.writeable = False
        object.__setattr__(self, "world_from_camera", poses)
        object.__setattr__(self, "intrinsics", intrinsics)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.world_from_camera)

    @property
    def camera_centres(self) -> Array:
        """Camera positions `(view, 3)` in world units."""
        return self.world_from_camera[:, :3, 3]

    def cameras(self, views: Sequence[int] | slice = slice(None), dtype: torch.dtype | None = None) -> PinholeCamera:
        """The cameras as `hyperplanes.geometry` takes them.

        Args:
            views: which of them; all by default.
            dtype: of their numbers; float64 by default.

        Returns:
            A batch of Kornia cameras.
        """
        from torch import as_tensor

        from hyperplanes.geometry.cameras import pinhole

        extrinsics = as_tensor(np.linalg.inv(self.world_from_camera[views]), dtype=dtype)
        return pinhole(as_tensor(self.intrinsics[views].copy(), dtype=dtype), extrinsics, self.height, self.width)


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
        name: one of RIGS; of a preset only the kind is taken, all its numbers are arguments here.
        views: number of views.
        resolution: pixels along a side; `fixed`, `random`, `orbit` and `spiral` also take (width, height).
        seed: seed of random rigs.
        distance: distance of the cameras from the origin in world units.
        field_of_view: full angle across the smaller side in degrees; None fits the unit sphere.

    Returns:
        The rig.

    Raises:
        ValueError: if no rig has that name, or a number makes no sense.
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

    Elevations are from `lowest` to `highest` degrees; the other arguments are those of `make_rig`.
    """
    _check_views(views)
    bottom, top = _height_band(lowest, highest)
    directions = np.empty((views, 3))
    for first in (0, 1):
        count = len(range(first, views, 2))
        if count:  # a golden spiral, uniform in area between the two heights
            heights = bottom + (top - bottom) * (np.arange(count) + 0.25 + 0.5 * first) / count
            azimuths = first * _GOLDEN_ANGLE / 2.0 + _GOLDEN_ANGLE * np.arange(count, dtype=np.float64)
            spread = _directions(heights, azimuths)
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

    Elevations are from `lowest` (0 for the upper hemisphere) to `highest` degrees; the other arguments are those of
    `make_rig`.
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

    The first is in the direction of +z, all are `elevation` degrees over the horizon; the other arguments are those of
    `make_rig`.

    Raises:
        ValueError: if the number of views, elevation, distance or resolution make no sense.
    """
    _check_views(views)
    if not -90.0 <= elevation <= 90.0:
        raise ValueError(f"elevation: expected -90 to 90 degrees, received {elevation}")
    azimuths = 2.0 * math.pi * np.arange(views) / views
    heights = np.full(views, math.sin(math.radians(elevation)))
    return _rig(_directions(heights, azimuths), resolution, distance, field_of_view)


def spiral(
    views: int = 251,
    resolution: int | tuple[int, int] = 128,
    *,
    distance: float = DEFAULT_DISTANCE,
    field_of_view: float | None = None,
) -> Rig:
    """Cameras on an Archimedean spiral over the upper hemisphere, from the horizon to the pole.

    Elevations grow by equal steps, 90 degrees in all, while the azimuth turns by 20 radians, as in the renderings of
    SRN's test objects (Sitzmann et al. 2019); the arguments are those of `make_rig`.
    """
    _check_views(views)
    steps = np.arange(views) / max(views - 1, 1)
    return _rig(_directions(np.sin(0.5 * math.pi * steps), -_SPIRAL_ANGLE * steps), resolution, distance, field_of_view)


def fitting_field_of_view(distance: float = DEFAULT_DISTANCE) -> float:
    """Field of view at which the unit sphere just fits, with a margin of 4 %.

    Args:
        distance: distance of the camera from the centre of the sphere, more than 1.04.

    Returns:
        The full angle in degrees, `2 asin(1.04 / distance)`.

    Raises:
        ValueError: if the camera is too near for any angle to do.

    >>> round(fitting_field_of_view(3.0), 3)
    40.567
    """
    if not distance > _MARGIN * OBJECT_RADIUS:
        raise ValueError(f"distance: expected more than {_MARGIN} (the object's radius is 1), received {distance}")
    return math.degrees(2.0 * math.asin(_MARGIN * OBJECT_RADIUS / distance))


def look_at_origin(centres: npt.ArrayLike) -> Array:
    """Poses of cameras that look at the origin with the world's y axis up in the picture.

    The poses of `hyperplanes.geometry.poses.look_at`, in numpy and exact at the centres; a test compares the two.

    Args:
        centres: camera positions `(view, 3)`, none of them the origin.

    Returns:
        `world_from_camera` `(view, 4, 4)`, OpenCV axes. Right above or below the origin, where no direction is up,
        the world's z axis is up in the picture.

    >>> look_at_origin([[0.0, 0.0, 3.0]])[0].round().astype(int).tolist()
    [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]]
    """
    positions = np.asarray(centres, dtype=np.float64)
    forward = -positions / np.linalg.norm(positions, axis=-1, keepdims=True)
    up = np.where(np.linalg.norm(forward[:, ::2], axis=-1, keepdims=True) >= 1e-6, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    poses = np.zeros((len(positions), 4, 4))
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = positions
    poses[:, 3, 3] = 1.0
    return poses + 0.0  # no negative zeros in what is written to disk


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
