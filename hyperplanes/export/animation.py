"""The choice of what renders an animation: the field, or, for many pictures, voxels fitted to the views."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

from kornia.geometry.camera import PinholeCamera

from hyperplanes.adaptation.base import AdaptedField, Renderable
from hyperplanes.export.baking import BakedScene, bake, default_side
from hyperplanes.export.voxel_fitting import MIN_UNGUIDED_VIEWS, VOXEL_STEPS, fit_voxels, render_guide
from hyperplanes.fields.baked import BakedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.views import Views

__all__ = ["Representation", "choose_representation", "draws_by_voxels", "fitted_voxels"]

Representation: TypeAlias = Literal["auto", "field", "voxels"]

PIXELS_PER_VOXEL_FACE = 24
"""Pixels of all pictures for each voxel of a face of the grid, from which on baking, fitting and rendering voxels takes
less time than rendering the field, on two cores."""


def draws_by_voxels(views: int, cameras: PinholeCamera, side: int) -> bool:
    """Whether voxels render the pictures faster than the field, and as well: many pictures and many views.

    >>> import torch
    >>> poses, lens = torch.eye(4).expand(48, 4, 4), camera.symmetric_intrinsics(400, 400, 0.8)
    >>> orbit = camera.pinhole(lens, poses, 400, 400)
    >>> draws_by_voxels(25, orbit, 256), draws_by_voxels(3, orbit, 256)
    (True, False)
    >>> draws_by_voxels(25, camera.select(orbit, [0]), 256)
    False

    Args:
        views: number of views that the field was adapted to; with few, voxels are worse than the field.
        cameras: of the pictures.
        side: voxels an axis.
    """
    height, width = camera.image_size(cameras)
    return views >= MIN_UNGUIDED_VIEWS and cameras.batch_size * height * width >= PIXELS_PER_VOXEL_FACE * side**2


def fitted_voxels(adapted: AdaptedField, views: Views, side: int, *, steps: int = VOXEL_STEPS) -> BakedField:
    """The voxels of a field, fitted to its support views.

    Args:
        adapted: the field to bake.
        views: its support views.
        side: voxels an axis.
        steps: gradient steps.
    """
    return fit_voxels(bake(adapted, side=side), views, guide=render_guide(adapted, views), steps=steps)


def choose_representation(
    field: Renderable,
    views: Views,
    cameras: PinholeCamera,
    representation: Representation = "auto",
    *,
    make: Callable[[AdaptedField, Views, int], BakedField] = fitted_voxels,
) -> Renderable:
    """The representation that renders an animation.

    Args:
        field: of the object; anything but an `AdaptedField`, such as baked voxels, is returned as it is.
        views: its support views, to which voxels are fitted.
        cameras: of all pictures.
        representation: "field", "voxels", or "auto" for what `draws_by_voxels` says; on a GPU, where fields are fast,
            "auto" is the field.
        make: makes voxels from the field, the views and the number of voxels an axis.

    Returns:
        The field itself, or its voxels.
    """
    if not isinstance(field, AdaptedField) or representation == "field":
        return field
    side = default_side(views.size)  # not by larger pictures: finer voxels than the views' pixels would show as dots
    if representation == "auto":
        on_cpu = field.occupancy.occupied.device.type == "cpu"
        if not (on_cpu and draws_by_voxels(len(views), cameras, side)):
            return field
    return BakedScene(make(field, views, side))
