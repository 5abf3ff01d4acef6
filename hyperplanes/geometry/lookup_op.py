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

from hyperplanes.geometry.lookup_torch import NEAREST_DEPTH
from hyperplanes.geometry.threads import share

__all__ = ["lookup", "lookup_backward"]

_BLOCK = 128  # points that the kernels take at once; `blocks.BLOCK`, which needs numba to import
_CHUNK = 64 * _BLOCK  # points a call of a kernel
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
    colours, coordinates, valid = _empty(points, images, views, _large)
    if valid.numel():
        kernel = _kernel("forward", points.dtype, views is not None)
        number = _number(points)
        fixed = (*_geometry(points, matrices, views), *_store(images, packed, bits), number(background))
        flat = [_flat(value) for value in (colours, coordinates, valid.view(torch.uint8))]
        fixed += (number(NEAREST_DEPTH), *flat)
        share(lambda start, stop: kernel(*fixed, start, stop), len(points), _CHUNK)
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


def _pitch(points: Tensor) -> int:
    """How long a row of one number a point is: on the CPU whole blocks of the kernels."""
    return -(-len(points) // _BLOCK) * _BLOCK if points.device.type == "cpu" else len(points)


def _empty(
    points: Tensor, images: Tensor, views: Tensor | None, new: Callable[..., Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Outputs of a lookup: (view, channel, point) in memory, seen as (point, view, channel)."""
    count, slots, room = len(points), images.shape[0] if views is None else views.shape[1], _pitch(points)
    new = new or points.new_empty
    colours = new((slots, images.shape[1], room), dtype=points.dtype).permute(2, 0, 1)[:count]
    coordinates = new((slots, 2, room), dtype=points.dtype).permute(2, 0, 1)[:count]
    return colours, coordinates, new((slots, room), dtype=torch.bool).T[:count]


def _large(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Uninitialised memory from NumPy, which asks Linux for large pages: three times faster to touch first."""
    return torch.from_numpy(np.empty(shape, str(dtype).removeprefix("torch.")))


def _flat(value: Tensor) -> np.ndarray:
    """The memory that a tensor lies in, room to spare included."""
    return value.new_empty(0).set_(value.untyped_storage()).numpy()


def _strided(value: Tensor) -> tuple[np.ndarray, tuple[int, ...]]:
    """The memory that a tensor spans, from its first element on, and its strides."""
    span = 1 + sum((size - 1) * stride for size, stride in zip(value.shape, value.stride(), strict=True))
    return value.detach().as_strided((span if value.numel() else 0,), (1,)).numpy(), value.stride()


def _kernel(name: str, dtype: torch.dtype, chosen: bool) -> Any:
    from hyperplanes.geometry.compiling import compiled

    return compiled(name, str(dtype).removeprefix("torch."), chosen)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _number(points: Tensor) -> type[np.floating[Any]]:
    """The scalar type that goes with the points."""
    return np.float64 if points.dtype == torch.float64 else np.float32


def _geometry(points: Tensor, matrices: Tensor, views: Tensor | None) -> tuple[Any, ...]:
    """Points as rows of x, y and z, the rows' length, the chosen views where there are any, and the matrices."""
    rows = np.zeros((3, _pitch(points)), _number(points))  # by NumPy: waking PyTorch's threads costs more than the work
    rows[:, : len(points)] = points.detach().numpy().T
    return (rows.reshape(-1), rows.shape[1], *(() if views is None else (_array(views),)), _array(matrices))


def _store(images: Tensor, packed: Tensor | None, bits: int) -> tuple[Any, ...]:
    words = np.zeros(0, np.uint32) if packed is None else _array(packed).reshape(-1).view(np.uint32)
    return _array(images), words, bits if packed is not None else 0, images.shape[2], images.shape[3]


def _geometry_gradient(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None,
    grad_colours: Tensor, grad_coordinates: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    rows = np.zeros((3, _pitch(points)), _number(points))
    if not grad_coordinates.numel():
        return torch.zeros_like(points), torch.zeros_like(matrices)
    kernel = _kernel("backward", points.dtype, views is not None)
    number = _number(points)
    fixed = (*_geometry(points, matrices, views), *_store(images, packed, bits), number(NEAREST_DEPTH))
    fixed += (*_strided(grad_colours), *_strided(grad_coordinates), rows.reshape(-1))

    def work(start: int, stop: int) -> np.ndarray:
        sums = np.zeros((len(matrices), 12))
        kernel(*fixed, sums, len(points), start, stop)
        return sums

    total = sum(share(work, len(points), _CHUNK), np.zeros((len(matrices), 12)))
    grad_points = torch.from_numpy(np.ascontiguousarray(rows[:, : len(points)].T))
    return grad_points, torch.from_numpy(total).to(matrices).reshape(matrices.shape)


def _image_gradient(
    points: Tensor, matrices: Tensor, images: Tensor, views: Tensor | None, grad_colours: Tensor
) -> Tensor:
    count, channels, height, width = images.shape
    pitch = _pixel_pitch(channels)
    flat = torch.from_numpy(np.zeros((count * height * width + 1) * pitch, str(images.dtype).removeprefix("torch.")))
    if grad_colours.numel():
        kernel = _kernel("image_backward", points.dtype, views is not None)
        fixed = (*_geometry(points, matrices, views), height, width, _number(points)(NEAREST_DEPTH))
        fixed += (*_strided(grad_colours), channels, pitch, flat.numpy(), len(points))
        # One plane at a time, whose pixels stay in the cache; but every call reads through all chosen views.
        step = 1 if views is None else -(-count // torch.get_num_threads())
        share(lambda start, stop: kernel(*fixed, start, stop), count, step)
    return flat[:-pitch].reshape(count, height, width, pitch)[..., :channels].permute(0, 3, 1, 2)


def _pixel_pitch(channels: int) -> int:
    """Numbers a pixel's gradient takes in memory: three channels are padded to a vector of four."""
    return 4 if channels == 3 else channels


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
        last = points.new_empty(count, height, width, _pixel_pitch(channels))[..., :channels].permute(0, 3, 1, 2)
    return (
        points.new_empty(points.shape if geometry else 0),
        points.new_empty(matrices.shape if geometry else 0),
        last if pixels else points.new_empty(0),
    )


lookup.register_autograd(_gradients, setup_context=_setup)


@lookup.register_kernel("cuda")
def _(points, matrices, images, packed, bits, views, background):
    from hyperplanes.geometry import lookup_triton

    return lookup_triton.lookup(points, matrices, images, views, background)


@lookup_backward.register_kernel("cuda")
def _(points, matrices, images, packed, bits, views, grad_colours, grad_coordinates, geometry, pixels):
    from hyperplanes.geometry import lookup_triton

    return lookup_triton.lookup_backward(
        points, matrices, images, views, grad_colours, grad_coordinates, geometry, pixels
    )
