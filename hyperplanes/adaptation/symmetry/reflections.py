"""Reflections of views: further views of a symmetric object."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import hull
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry, reflected_cameras
from hyperplanes.rendering.footprint import footprint
from hyperplanes.views import Views, join_views, moved

__all__ = [
    "HULL_SIDE",
    "MIN_OBJECT_OPACITY",
    "UNKNOWN_OPACITY",
    "images_by",
    "penalty_offsets",
    "reflected",
    "with_reflections",
]

HULL_SIDE = 96  # voxels an axis of the hull in which asymmetric parts are looked for
MIN_OBJECT_OPACITY = 0.9  # least opacity of a mask in a pixel that shows the object
UNKNOWN_OPACITY = 0.97  # opacity of pixels in which a reflection is known to be wrong: not carved, and colour not used
REFLECTION_PENALTY = 0.05  # penalty of reflections as planes: light comes from one side, and writing is reversed
# the same for those about other planes, about which few objects are symmetric in every detail
OTHER_PLANE_PENALTY = 0.2


def reflected(views: Views, plane: Plane) -> Views:
    """The views of the mirror image of an object: flipped images with reflected cameras.

    Args:
        views: of the object.
        plane: of the reflection.
    """
    masks = None if views.masks is None else views.masks.flip(3)
    cameras = reflected_cameras(views.cameras, plane)
    return Views(views.images.flip(3), cameras, masks, views.bounds, views.names, views.up)


def images_by(views: Views, symmetry: Symmetry) -> Views:
    """The views, followed by their reflections about the plane, and then by the rotations of both.

    Args:
        views: of the object.
        symmetry: of the object.
    """
    both = join_views(views, reflected(views, symmetry.plane))
    return join_views(both, *(moved(both, rotation) for rotation in symmetry.rotations[1:]))


def penalty_offsets(given: int, symmetry: Symmetry) -> Float[Tensor, " view"]:
    """The penalties of the views of `images_by` as planes.

    Args:
        given: number of views without reflections.
        symmetry: of the object.
    """
    result = torch.full((given * symmetry.images,), OTHER_PLANE_PENALTY)
    result[: 2 * given] = REFLECTION_PENALTY
    result[:given] = 0.0
    return result


@torch.no_grad()
def with_reflections(support: Views, symmetry: Symmetry | None, known: Occupancy | None = None) -> Views:
    """The views, followed by their reflections (`images_by`).

    Few objects are symmetric in all parts. Whatever views show outside the visual hull of views and reflections is an
    asymmetric part. Where it would appear in a reflection, the opacity is UNKNOWN_OPACITY.

    Args:
        support: of an object that is symmetric, except for some parts.
        symmetry: None returns the views unchanged.
        known: the visual hull of the views, HULL_SIDE voxels an axis; computed by default.
    """
    if symmetry is None:
        return support
    found = images_by(support, symmetry)
    if support.masks is None or found.masks is None:
        return found
    reflections = found[len(support) :]
    parts = _asymmetric_parts(support, reflections, known or hull(support, HULL_SIDE))
    if parts.occupied.any():
        wrong = footprint(parts, reflections.cameras)[:, None]
        masks = torch.where(wrong, UNKNOWN_OPACITY, found.masks[len(support) :])
        found = replace(found, masks=torch.cat([support.masks, masks]))
    return found


def _asymmetric_parts(support: Views, reflections: Views, found: Occupancy) -> Occupancy:
    """The voxels of the hull of views that project to pixels which the hull with reflections does not cover."""
    assert support.masks is not None
    assert reflections.masks is not None
    common = carve(reflections.masks, reflections.cameras, found.bounds, HULL_SIDE, within=found)
    missed = (support.masks >= MIN_OBJECT_OPACITY) & ~footprint(common, support.cameras)[:, None]
    points, occupied = found.centres().to(support.images), found.occupied.clone()
    where = ImagePlanes(missed.to(support.images), support.cameras, background=0.0).lookup(points).colours
    occupied[found.occupied] = where.amax(1)[:, 0] > 0.5
    return replace(found, occupied=occupied)
