"""The fused lookup for CUDA devices, in Triton: one program a block of points, all planes in a loop.

Lookup and gradient are those of the CPU kernels. Points, matrices and images keep their layouts; results are planar,
(view, channel, point), so that a warp writes whole lines. Gradients with respect to images and
matrices are summed by atomics, so their last digits may differ from run to run.
"""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

from hyperplanes.geometry.lookup_torch import BORDER_TOLERANCE, MIN_Z

__all__ = ["lookup", "lookup_backward"]

_BLOCK = 128
_BORDER = tl.constexpr(BORDER_TOLERANCE)


@triton.jit
@no_type_check
def _project(matrices, view, x, y, z, inside_block, min_z):
    """(u, v, 1 / z, in front) of points under one plane's matrix, or one matrix a point."""
    m = matrices + view * 12
    camera_z = (
        tl.load(m + 8, inside_block) * x
        + tl.load(m + 9, inside_block) * y
        + tl.load(m + 10, inside_block) * z
        + tl.load(m + 11, inside_block)
    )
    front = (camera_z > min_z) & (camera_z < float("inf"))
    reciprocal = tl.where(front, 1.0 / tl.where(front, camera_z, 1.0), 0.0)
    u = (
        tl.load(m, inside_block) * x
        + tl.load(m + 1, inside_block) * y
        + tl.load(m + 2, inside_block) * z
        + tl.load(m + 3, inside_block)
    ) * reciprocal
    v = (
        tl.load(m + 4, inside_block) * x
        + tl.load(m + 5, inside_block) * y
        + tl.load(m + 6, inside_block) * z
        + tl.load(m + 7, inside_block)
    ) * reciprocal
    return u, v, reciprocal, front


@triton.jit
@no_type_check
def _place(u, v, front, height, width):
    """Clamped pixel, its corner and fractions, and whether it is inside."""
    across = (u >= -_BORDER) & (u <= width - 1 + _BORDER)
    inside = front & across & (v >= -_BORDER) & (v <= height - 1 + _BORDER)
    u = tl.minimum(tl.where(u > 0, u, 0.0), width - 1.0)
    v = tl.minimum(tl.where(v > 0, v, 0.0), height - 1.0)
    column = tl.minimum(u.to(tl.int32), tl.maximum(width - 2, 0))
    row = tl.minimum(v.to(tl.int32), tl.maximum(height - 2, 0))
    return u, v, column, row, inside


@triton.jit
@no_type_check
def _forward(points, matrices, images, views, colours, coordinates, valid, count, planes, height, width, background,
             min_z, CHANNELS: tl.constexpr, CHOSEN: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = point < count
    x = tl.load(points + point * 3, here, 0.0)
    y = tl.load(points + point * 3 + 1, here, 0.0)
    z = tl.load(points + point * 3 + 2, here, 0.0)
    right, below = tl.where(width > 1, 1, 0), tl.where(height > 1, width, 0)
    for slot in range(planes):
        view = tl.full((BLOCK,), slot, tl.int64)
        if CHOSEN:
            view = tl.load(views + point.to(tl.int64) * planes + slot, here, 0)
        # Project and clamp; write coordinates and validity.
        u, v, _, front = _project(matrices, view, x, y, z, here, min_z)
        u, v, column, row, inside = _place(u, v, front, height, width)
        fx, fy = u - column, v - row
        plane = tl.full((BLOCK,), slot, tl.int64)
        at = 2 * plane * count + point
        tl.store(coordinates + at, tl.where(front, 2 * u / tl.maximum(width - 1, 1) - 1, 0.0), here)
        tl.store(coordinates + at + count, tl.where(front, 2 * v / tl.maximum(height - 1, 1) - 1, 0.0), here)
        tl.store(valid + plane * count + point, inside.to(tl.uint8), here)
        # Interpolate and write colours.
        for channel in tl.static_range(CHANNELS):
            tap = images + (view * CHANNELS + channel) * height * width + row * width + column
            seen = here & inside
            a = tl.load(tap, seen, 0.0)
            b = tl.load(tap + right, seen, 0.0)
            c = tl.load(tap + below, seen, 0.0)
            d = tl.load(tap + below + right, seen, 0.0)
            top = a + fx * (b - a)
            value = top + fy * (c + fx * (d - c) - top)
            at = (plane * CHANNELS + channel) * count + point
            tl.store(colours + at, tl.where(inside, value, background), here)


@triton.jit
@no_type_check
def _backward(points, matrices, images, views, grad_colours, grad_coordinates, grad_points, grad_matrices, grad_images,
              c0, c1, c2, q0, q1, q2, count, planes, height, width, min_z, CHANNELS: tl.constexpr,
              CHOSEN: tl.constexpr, GEOMETRY: tl.constexpr, PIXELS: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = point < count
    wide = point.to(tl.int64)
    x = tl.load(points + point * 3, here, 0.0)
    y = tl.load(points + point * 3 + 1, here, 0.0)
    z = tl.load(points + point * 3 + 2, here, 0.0)
    right, below = tl.where(width > 1, 1, 0), tl.where(height > 1, width, 0)
    gx, gy, gz = x * 0.0, y * 0.0, z * 0.0
    for slot in range(planes):
        view = tl.full((BLOCK,), slot, tl.int64)
        if CHOSEN:
            view = tl.load(views + wide * planes + slot, here, 0)
        raw_u, raw_v, reciprocal, front = _project(matrices, view, x, y, z, here, min_z)
        u, v, column, row, inside = _place(raw_u, raw_v, front, height, width)
        fx, fy = u - column, v - row
        seen = here & inside
        gu, gv = x * 0.0, y * 0.0
        free_u = here & front & (raw_u >= 0) & (raw_u <= width - 1)
        free_v = here & front & (raw_v >= 0) & (raw_v <= height - 1)
        # Gradients with respect to the pixel: of the coordinates, then of the interpolation.
        if GEOMETRY:
            at = wide * q0 + slot * q1
            gu = 2 * tl.load(grad_coordinates + at, free_u, 0.0) / tl.maximum(width - 1, 1)
            gv = 2 * tl.load(grad_coordinates + at + q2, free_v, 0.0) / tl.maximum(height - 1, 1)
        for channel in tl.static_range(CHANNELS):
            gradient = tl.load(grad_colours + wide * c0 + slot * c1 + channel * c2, seen, 0.0)
            offset = (view * CHANNELS + channel) * height * width + row * width + column
            if GEOMETRY:
                a = tl.load(images + offset, seen, 0.0)
                b = tl.load(images + offset + right, seen, 0.0)
                c = tl.load(images + offset + below, seen, 0.0)
                d = tl.load(images + offset + below + right, seen, 0.0)
                twist = (d - c) - (b - a)
                gu += gradient * ((b - a) + fy * twist)
                gv += gradient * ((c - a) + fx * twist)
            if PIXELS:
                tl.atomic_add(grad_images + offset, gradient * (1 - fx) * (1 - fy), seen)
                tl.atomic_add(grad_images + offset + right, gradient * fx * (1 - fy), seen)
                tl.atomic_add(grad_images + offset + below, gradient * (1 - fx) * fy, seen)
                tl.atomic_add(grad_images + offset + below + right, gradient * fx * fy, seen)
        # From the pixel to point and matrix: dL/dh = (g_u, g_v, -(g_u u + g_v v)) / h2.
        if GEOMETRY:
            h0, h1 = tl.where(free_u, gu, 0.0) * reciprocal, tl.where(free_v, gv, 0.0) * reciprocal
            h2 = -(h0 * tl.where(front, raw_u, 0.0) + h1 * tl.where(front, raw_v, 0.0))
            m = matrices + view * 12
            gx += tl.load(m, here, 0.0) * h0 + tl.load(m + 4, here, 0.0) * h1 + tl.load(m + 8, here, 0.0) * h2
            gy += tl.load(m + 1, here, 0.0) * h0 + tl.load(m + 5, here, 0.0) * h1 + tl.load(m + 9, here, 0.0) * h2
            gz += tl.load(m + 2, here, 0.0) * h0 + tl.load(m + 6, here, 0.0) * h1 + tl.load(m + 10, here, 0.0) * h2
            if CHOSEN:
                to = grad_matrices + view * 12
                _add_row(to, h0, x, y, z, here)
                _add_row(to + 4, h1, x, y, z, here)
                _add_row(to + 8, h2, x, y, z, here)
            else:
                to = grad_matrices + slot * 12
                _add_sums(to, h0, x, y, z)
                _add_sums(to + 4, h1, x, y, z)
                _add_sums(to + 8, h2, x, y, z)
    if GEOMETRY:
        tl.store(grad_points + point * 3, gx, here)
        tl.store(grad_points + point * 3 + 1, gy, here)
        tl.store(grad_points + point * 3 + 2, gz, here)


@triton.jit
@no_type_check
def _add_row(to, h, x, y, z, here):
    tl.atomic_add(to, h * x, here)
    tl.atomic_add(to + 1, h * y, here)
    tl.atomic_add(to + 2, h * z, here)
    tl.atomic_add(to + 3, h, here)


@triton.jit
@no_type_check
def _add_sums(to, h, x, y, z):
    tl.atomic_add(to, tl.sum(h * x))
    tl.atomic_add(to + 1, tl.sum(h * y))
    tl.atomic_add(to + 2, tl.sum(h * z))
    tl.atomic_add(to + 3, tl.sum(h))


def lookup(
    points: Tensor, matrices: Tensor, images: Tensor, views: Tensor | None, background: float, nearest: float = MIN_Z
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (point, view, channel), coordinates (point, view, 2) and validity (point, view), planar in memory."""
    points, matrices, images = points.contiguous(), matrices.contiguous(), images.contiguous()
    count, channels, height, width = images.shape
    slots, total = count if views is None else views.shape[1], len(points)
    colours = points.new_empty(slots, channels, total)
    coordinates = points.new_empty(slots, 2, total)
    valid = points.new_empty(slots, total, dtype=torch.bool)
    if total and slots:
        chosen = points if views is None else views.contiguous()
        _forward[(triton.cdiv(total, _BLOCK),)](  # pyright: ignore[reportIndexIssue]
            points, matrices, images, chosen, colours, coordinates, valid.view(torch.uint8), total, slots, height,
            width, background, nearest, CHANNELS=channels, CHOSEN=views is not None, BLOCK=_BLOCK,
        )  # fmt: skip
        if points.dtype == torch.float64:  # Triton passes numbers in single precision
            colours = torch.where(valid[:, None], colours, background)
    return colours.permute(2, 0, 1), coordinates.permute(2, 0, 1), valid.T


def lookup_backward(
    points: Tensor, matrices: Tensor, images: Tensor, views: Tensor | None, grad_colours: Tensor | None,
    grad_coordinates: Tensor | None, geometry: bool, pixels: bool, nearest: float = MIN_Z,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to points, matrices and images; empty where not asked for."""
    points, matrices, images = points.contiguous(), matrices.contiguous(), images.contiguous()
    count, channels, height, width = images.shape
    slots, total = count if views is None else views.shape[1], len(points)
    zero = points.new_zeros(())
    colour = zero.expand(total, slots, channels) if grad_colours is None else grad_colours
    coordinate = zero.expand(total, slots, 2) if grad_coordinates is None else grad_coordinates
    grad_points = points.new_zeros(points.shape if geometry else 0)
    grad_matrices = points.new_zeros(matrices.shape if geometry else 0)
    grad_images = images.new_zeros(images.shape if pixels else 0)
    if total and slots:
        chosen = points if views is None else views.contiguous()
        _backward[(triton.cdiv(total, _BLOCK),)](  # pyright: ignore[reportIndexIssue]
            points, matrices, images, chosen, colour, coordinate, grad_points, grad_matrices, grad_images,
            *colour.stride(), *coordinate.stride(), total, slots, height, width, nearest, CHANNELS=channels,
            CHOSEN=views is not None, GEOMETRY=geometry, PIXELS=pixels, BLOCK=_BLOCK,
        )  # fmt: skip
    return grad_points, grad_matrices, grad_images
