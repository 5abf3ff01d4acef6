"""The fused lookup as a PyTorch operator, `hyperplanes::lookup`, and its gradient, `hyperplanes::lookup_backward`.

Registered with `torch.library`, so that autograd, `torch.compile` and fake tensors know them. This file holds what all
device types share, shapes and the gradient's wiring, and the CPU's way to its kernels; `lookup_triton` has those for
CUDA. Second derivatives need the plain torch backend.
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
from hyperplanes.geometry.lookup_torch import MIN_Z

__all__ = ["lookup", "lookup_backward"]

_CHUNK = 64 * memory.BLOCK  # points a call of a kernel at least
_PLANES = "Tensor points, Tensor matrices, Tensor images, Tensor? packed, int bits, Tensor? views"
_SCHEMA = f"({_PLANES}, float background) -> (Tensor, Tensor, Tensor)"
_BACKWARD_SCHEMA = (
    f"({_PLANES}, Tensor? grad_colours, Tensor? grad_coordinates, bool geometry, bool pixels)"
    " -> (Tensor, Tensor, Tensor)"
)


@torch.library.custom_op("hyperplanes::lookup", mutates_args=(), device_types="cpu", schema=_SCHEMA)
def lookup(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None,
    background: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Colours (point, view, channel), coordinates (point, view, 2) and validity (point, view), planar in memory."""
    colours, coordinates, valid = _empty(points, images, views, memory.uninitialised)
    if valid.numel():
        kernel = compile_kernel("lookup_forward.forward", points.dtype, views is not None)
        number = memory.number(points)
        fixed = (*_geometry(points, matrices, views), *memory.planes(images, packed, bits), number(background))
        flat = [memory.flat(value) for value in (colours, coordinates, valid.view(torch.uint8))]
        fixed += (number(MIN_Z), *flat)
        parallel_for(lambda start, stop: kernel(*fixed, start, stop), len(points), _chunk(points, packed, views))
    return colours, coordinates, valid


@torch.library.custom_op("hyperplanes::lookup_backward", mutates_args=(), device_types="cpu", schema=_BACKWARD_SCHEMA)
def lookup_backward(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None,
    grad_colours: Tensor | None, grad_coordinates: Tensor | None, geometry: bool, pixels: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to points, matrices and images; empty where not asked for."""
    rows = (len(points), images.shape[0] if views is None else views.shape[1])
    zero = points.new_zeros(())
    colour = zero.expand(*rows, images.shape[1]) if grad_colours is None else grad_colours
    coordinate = zero.expand(*rows, 2) if grad_coordinates is None else grad_coordinates
    grad_points, grad_matrices, grad_images = (points.new_empty(0) for _ in range(3))
    if geometry:
        grad_points, grad_matrices = _geometry_gradient(
            points, matrices, images, packed, bits, views, colour, coordinate
        )
    if pixels:
        grad_images = _image_gradient(points, matrices, images, views, colour)
    return grad_points, grad_matrices, grad_images


def _empty(
    points: Tensor, images: Tensor, views: Tensor | None, new: Callable[..., Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Outputs of a lookup: (view, channel, point) in memory, seen as (point, view, channel)."""
    count, slots, room = len(points), images.shape[0] if views is None else views.shape[1], memory.pitch(points)
    new = new or points.new_empty
    colours = new((slots, images.shape[1], room), dtype=points.dtype).permute(2, 0, 1)[:count]
    coordinates = new((slots, 2, room), dtype=points.dtype).permute(2, 0, 1)[:count]
    return colours, coordinates, new((slots, room), dtype=torch.bool).T[:count]


def _chunk(points: Tensor, packed: Tensor | None, views: Tensor | None) -> int:
    """Points a call of a kernel: an equal share a thread, to gain from planes interleaved for them; few, elsewhere."""
    equal = -(-len(points) // (torch.get_num_threads() * memory.BLOCK)) * memory.BLOCK
    return max(_CHUNK, equal) if packed is None and views is None else _CHUNK


def _geometry(points: Tensor, matrices: Tensor, views: Tensor | None) -> tuple[Any, ...]:
    """Points as rows of x, y and z, the rows' length, the chosen views where there are any, and the matrices."""
    rows = np.zeros(
        (3, memory.pitch(points)), memory.number(points)
    )  # by NumPy: waking PyTorch's threads costs more than the work
    rows[:, : len(points)] = points.detach().numpy().T
    return (rows.reshape(-1), rows.shape[1], *(() if views is None else (memory.array(views),)), memory.array(matrices))


def _geometry_gradient(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None,
    grad_colours: Tensor, grad_coordinates: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    rows = np.zeros((3, memory.pitch(points)), memory.number(points))
    if not grad_coordinates.numel():
        return torch.zeros_like(points), torch.zeros_like(matrices)
    kernel = compile_kernel("lookup_backward.backward", points.dtype, views is not None)
    number = memory.number(points)
    fixed = (*_geometry(points, matrices, views), *memory.planes(images, packed, bits), number(MIN_Z))
    fixed += (*memory.strided(grad_colours), *memory.strided(grad_coordinates), rows.reshape(-1))

    def work(start: int, stop: int) -> np.ndarray:
        sums = np.zeros((len(matrices), 12))
        kernel(*fixed, sums, len(points), start, stop)
        return sums

    total = sum(parallel_for(work, len(points), _chunk(points, packed, views)), np.zeros((len(matrices), 12)))
    grad_points = torch.from_numpy(np.ascontiguousarray(rows[:, : len(points)].T))
    return grad_points, torch.from_numpy(total).to(matrices).reshape(matrices.shape)


def _image_gradient(
    points: Tensor, matrices: Tensor, images: Tensor, views: Tensor | None, grad_colours: Tensor
) -> Tensor:
    filled, gradient = memory.pixel_gradient(images)
    if grad_colours.numel():
        kernel = compile_kernel("lookup_backward.image_backward", points.dtype, views is not None)
        fixed = (*_geometry(points, matrices, views), *images.shape[2:], memory.number(points)(MIN_Z))
        channels = images.shape[1]
        fixed += (*memory.strided(grad_colours), channels, memory.pixel_pitch(channels), filled, len(points))
        # One plane at a time, whose pixels stay in the cache; but every call reads through all chosen views.
        step = 1 if views is None else -(-len(images) // torch.get_num_threads())
        parallel_for(lambda start, stop: kernel(*fixed, start, stop), len(images), step)
    return gradient


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    points, matrices, images, packed, bits, views, _ = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[-1])
    ctx.save_for_backward(points, matrices, images, packed, views)
    ctx.bits = bits


def _gradients(
    ctx: Any, grad_colours: Tensor | None, grad_coordinates: Tensor | None, _: None
) -> tuple[Tensor | None, ...]:
    points, matrices, images, packed, views = ctx.saved_tensors
    geometry, pixels = ctx.needs_input_grad[0] or ctx.needs_input_grad[1], ctx.needs_input_grad[2]
    if grad_colours is None and grad_coordinates is None:
        return (None,) * 7
    grad_points, grad_matrices, grad_images = lookup_backward(
        points, matrices, images, packed, ctx.bits, views, grad_colours, grad_coordinates, geometry, pixels
    )
    return (
        grad_points if ctx.needs_input_grad[0] else None,
        grad_matrices if ctx.needs_input_grad[1] else None,
        grad_images if pixels else None,
        *(None,) * 4,
    )


@lookup.register_fake
def _(points, matrices, images, packed, bits, views, background):
    return _empty(points, images, views)


@lookup_backward.register_fake
def _(points, matrices, images, packed, bits, views, grad_colours, grad_coordinates, geometry, pixels):
    count, channels, height, width = images.shape
    last = points.new_empty(images.shape)
    if points.device.type == "cpu":
        last = points.new_empty(count, height, width, memory.pixel_pitch(channels))[..., :channels].permute(0, 3, 1, 2)
    return (
        points.new_empty(points.shape if geometry else 0),
        points.new_empty(matrices.shape if geometry else 0),
        last if pixels else points.new_empty(0),
    )


lookup.register_autograd(_gradients, setup_context=_setup)


@lookup.register_kernel("cuda")
def _(points, matrices, images, packed, bits, views, background):
    from hyperplanes.geometry.kernels import lookup_triton

    return lookup_triton.lookup(points, matrices, images, views, background)


@lookup_backward.register_kernel("cuda")
def _(points, matrices, images, packed, bits, views, grad_colours, grad_coordinates, geometry, pixels):
    from hyperplanes.geometry.kernels import lookup_triton

    return lookup_triton.lookup_backward(
        points, matrices, images, views, grad_colours, grad_coordinates, geometry, pixels
    )
