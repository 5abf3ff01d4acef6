"""Fused sampling as a PyTorch operator, `hyperplanes::sample`, and its gradient, `hyperplanes::sample_backward`.

Registered with `torch.library` as the lookup is, see `lookup_op`; for the CPU alone. Second derivatives need the plain
torch backend.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hyperplanes.geometry.kernels import memory
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for

__all__ = ["sample", "sample_backward"]

_INPUTS = "Tensor images, Tensor coordinates, Tensor? packed, int bits"
_SCHEMA = f"({_INPUTS}, float background) -> Tensor"
_BACKWARD_SCHEMA = f"({_INPUTS}, Tensor grad_colours, bool geometry, bool pixels) -> (Tensor, Tensor)"


@torch.library.custom_op("hyperplanes::sample", mutates_args=(), device_types="cpu", schema=_SCHEMA)
def sample(images: Tensor, coordinates: Tensor, packed: Tensor | None, bits: int, background: float) -> Tensor:
    """Colours (point, view, channel), planar in memory."""
    colours = _planar(coordinates, images.shape[1], memory.uninitialised)
    total = len(coordinates)
    if colours.numel():
        kernel = compile_kernel("sample.sample", coordinates.dtype)
        fixed = (*memory.planes(images, packed, bits), memory.number(coordinates)(background))
        chunk = _chunk(total, len(images))
        fixed += (*memory.strided(coordinates), memory.flat(colours), memory.pitch(coordinates), total, chunk)
        _spread(lambda start, stop: kernel(*fixed, start, stop), len(images) * -(-total // chunk))
    return colours


@torch.library.custom_op("hyperplanes::sample_backward", mutates_args=(), device_types="cpu", schema=_BACKWARD_SCHEMA)
def sample_backward(
    images: Tensor, coordinates: Tensor, packed: Tensor | None, bits: int, grad_colours: Tensor, geometry: bool,
    pixels: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to images and coordinates; empty where not asked for."""
    total, empty = len(coordinates), np.zeros(0, memory.number(coordinates))
    filled, grad_images = memory.pixel_gradient(images) if pixels else (empty, images.new_empty(0))
    grad_coordinates = _planar(coordinates, 2, memory.uninitialised) if geometry else coordinates.new_empty(0)
    if not grad_colours.numel():
        return grad_images, torch.zeros_like(coordinates) if geometry else grad_coordinates
    kernel = compile_kernel("sample.sample_backward", coordinates.dtype)
    chunk = total if pixels else _chunk(total, len(images))  # two threads must not add to one pixel: a plane each
    fixed = (*memory.planes(images, packed, bits), *memory.strided(coordinates), *memory.strided(grad_colours))
    fixed += (memory.flat(grad_coordinates) if geometry else empty, memory.pitch(coordinates), filled)
    fixed += (memory.pixel_pitch(images.shape[1]), total, chunk)
    _spread(lambda start, stop: kernel(*fixed, start, stop), len(images) * -(-total // chunk))
    return grad_images, grad_coordinates


def _spread(work: Callable[[int, int], None], pieces: int) -> None:
    """The work in a few calls a thread: each sets memory aside, whose first touch takes a tenth of a plane's time."""
    parallel_for(work, pieces, -(-pieces // (4 * torch.get_num_threads())))


def _chunk(total: int, planes: int) -> int:
    """Points on one plane that a thread takes at once: whole planes, where there are some for every thread."""
    parts = -(-2 * torch.get_num_threads() // planes)
    return max(1, -(-total // (parts * memory.BLOCK))) * memory.BLOCK


def _planar(coordinates: Tensor, numbers: int, new: Callable[..., Tensor]) -> Tensor:
    """Memory for some numbers a lookup: (view, number, point), seen as (point, view, number)."""
    shape = (coordinates.shape[1], numbers, memory.pitch(coordinates))
    return new(shape, dtype=coordinates.dtype).permute(2, 0, 1)[: len(coordinates)]


def _setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    images, coordinates, packed, bits, _ = inputs
    ctx.save_for_backward(images, coordinates, packed)
    ctx.bits = bits


def _gradients(ctx: Any, grad_colours: Tensor) -> tuple[Tensor | None, ...]:
    images, coordinates, packed = ctx.saved_tensors
    pixels, geometry = ctx.needs_input_grad[0], ctx.needs_input_grad[1]
    grad_images, grad_coordinates = sample_backward(
        images, coordinates, packed, ctx.bits, grad_colours, geometry, pixels
    )
    return grad_images if pixels else None, grad_coordinates if geometry else None, None, None, None


@sample.register_fake
def _(images, coordinates, packed, bits, background):
    return _planar(coordinates, images.shape[1], coordinates.new_empty)


@sample_backward.register_fake
def _(images, coordinates, packed, bits, grad_colours, geometry, pixels):
    count, channels, height, width = images.shape
    room = images.new_empty(count, height, width, memory.pixel_pitch(channels) if pixels else 0)
    grad_images = room[..., :channels].permute(0, 3, 1, 2) if pixels else images.new_empty(0)
    return grad_images, _planar(coordinates, 2, coordinates.new_empty) if geometry else coordinates.new_empty(0)


sample.register_autograd(_gradients, setup_context=_setup)
