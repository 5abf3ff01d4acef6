"""Checks of shapes, types and indices, since the kernels access memory without bounds checks."""

from __future__ import annotations

import torch
from torch import Tensor

from hyperplanes.geometry.inputs import check_indices

__all__ = ["check_gradient", "check_lookup", "check_sample"]

_NUMBERS = (torch.float32, torch.float64)
_MOST_PIXELS = 2**31  # the kernels count an image's pixels in 32 bits


def check_lookup(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None
) -> None:
    """Check that the kernels of lookup stay inside these tensors.

    Raises:
        ValueError: a shape, type or index with which they would not.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape (point, 3), got {tuple(points.shape)}")
    _check_planes(points, images, packed, bits)
    if matrices.shape != (len(images), 3, 4) or matrices.dtype != points.dtype:
        raise ValueError(
            f"matrices: expected {points.dtype} of shape ({len(images)}, 3, 4), one an image, "
            f"got {matrices.dtype} {tuple(matrices.shape)}"
        )
    if views is None:
        return
    if views.ndim != 2 or len(views) != len(points) or views.dtype != torch.int64:
        raise ValueError(
            f"views: expected int64 of shape ({len(points)}, chosen), a row a point, "
            f"got {views.dtype} {tuple(views.shape)}"
        )
    check_indices(views, len(images))


def check_sample(images: Tensor, coordinates: Tensor, packed: Tensor | None, bits: int) -> None:
    """Check that the kernels of sampling stay inside these tensors.

    Raises:
        ValueError: a shape or type with which they would not.
    """
    if coordinates.ndim != 3 or coordinates.shape[1:] != (len(images), 2):
        raise ValueError(
            f"coordinates: expected shape (point, {len(images)}, 2), {len(images)} being the number of images, "
            f"got {tuple(coordinates.shape)}"
        )
    _check_planes(coordinates, images, packed, bits)


def check_gradient(name: str, gradient: Tensor | None, shape: tuple[int, ...], like: Tensor) -> None:
    """Check that an incoming gradient has the shape of its result.

    Raises:
        ValueError: another shape or type.
    """
    if gradient is not None and (tuple(gradient.shape) != shape or gradient.dtype != like.dtype):
        raise ValueError(f"{name}: expected {like.dtype} {shape}, got {gradient.dtype} {tuple(gradient.shape)}")


def _check_planes(like: Tensor, images: Tensor, packed: Tensor | None, bits: int) -> None:
    if like.dtype not in _NUMBERS or images.dtype != like.dtype:
        raise ValueError(f"images: expected float32 or float64, as the points, got {images.dtype} and {like.dtype}")
    if images.ndim != 4 or (len(images) and not 0 < images.shape[2] * images.shape[3] < _MOST_PIXELS):
        raise ValueError(
            f"images: expected shape (view, channel, height, width) of 1 to 2^31 - 1 pixels, got {tuple(images.shape)}"
        )
    if packed is None:
        return
    expected = (len(images), *images.shape[2:])
    if tuple(packed.shape) != expected or packed.dtype != torch.int32 or bits not in (8, 11) or images.shape[1] != 3:
        raise ValueError(
            f"packed: expected int32 {expected} of 8 or 11 bits for images of three channels, "
            f"got {packed.dtype} {tuple(packed.shape)} of {bits} for {images.shape[1]}"
        )
