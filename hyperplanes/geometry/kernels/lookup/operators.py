"""Lookup and sampling as PyTorch operators, `hyperplanes::lookup` and `hyperplanes::sample`, with their gradients.

Registered with `torch.library` for autograd, `torch.compile` and fake tensors. This file holds shapes
and autograd for all device types, and the calls of the CPU kernels; `lookup_triton` has those for CUDA, which has no
kernel for sampling alone. A gradient that is itself to be differentiated is computed in plain PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hyperplanes.geometry import lookup_torch
from hyperplanes.geometry.kernels import memory
from hyperplanes.geometry.kernels.checks import check_gradient, check_lookup, check_sample
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for

__all__ = ["lookup", "lookup_backward", "sample", "sample_backward"]

_CHUNK = 64 * memory.BLOCK  # points per kernel call
_PLANES = "Tensor points, Tensor matrices, Tensor images, Tensor? packed, int bits, Tensor? views, float nearest"
_SAMPLED = "Tensor images, Tensor coordinates, Tensor? packed, int bits"
_GRADIENTS = "Tensor? grad_colours, Tensor? grad_coordinates, bool geometry, bool pixels"


def _operator(name: str, schema: str) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: the operator `hyperplanes::NAME`, of which the function is the CPU's kernel.

    `torch.library.custom_op` would import torch._dynamo at the first call, which takes 1.3 to 2 s.
    """

    def register(function: Callable[..., Any]) -> Any:
        torch.library.define(f"hyperplanes::{name}", schema, tags=torch.Tag.pt2_compliant_tag)
        torch.library.impl(f"hyperplanes::{name}", "cpu", function)
        return getattr(torch.ops.hyperplanes, name).default

    return register


@dataclass(frozen=True)
class _Points:
    """The points of a kernel call, and the planes of each.

    Attributes:
        kind: "projected" or "given".
        arguments: points as rows of x, y and z, the length of a row, matrices; coordinates and their strides.
        like: a tensor of the dtype to compute in.
        total: number of points on each plane, or the length of a row where every point has its own planes.
        groups: segments (view, begin, end) of the points grouped by plane; None where all points fall on all planes.
        position: place of each (point, slot) among the grouped points.
    """

    kind: str
    arguments: tuple[Any, ...]
    like: Tensor
    total: int
    groups: np.ndarray | None = None
    position: np.ndarray | None = None

    @classmethod
    def projected(cls, points: Tensor, matrices: Tensor, views: Tensor | None) -> _Points:
        """World points and projection matrices."""
        if views is None:
            rows, groups, position = _rows(points, memory.pitch(points)), None, None
        else:
            groups, position, pitch = _grouped(memory.array(views).reshape(-1), len(matrices))
            rows = np.zeros((3, pitch), memory.number(points))
            rows[:, position] = points.detach().numpy().T.repeat(views.shape[1], 1)
        arguments = (rows.reshape(-1), rows.shape[1], memory.array(matrices), None, None)
        return cls("projected", arguments, points, len(points) if views is None else rows.shape[1], groups, position)

    @classmethod
    def given(cls, coordinates: Tensor) -> _Points:
        """Coordinates in [-1, 1]."""
        arguments = (None, memory.pitch(coordinates), None, *memory.strided(coordinates))
        return cls("given", arguments, coordinates, len(coordinates))

    def run(self, kernel: Callable[[np.ndarray], Any], planes: int, whole_planes: bool, packed: bool = False) -> list:
        """Run the kernel on all segments in all threads; `whole_planes` where no two threads may write to one plane."""
        if (groups := self.groups) is not None:
            step = -(-max(1, len(groups)) // (torch.get_num_threads() * (1 if whole_planes else 4)))
            return parallel_for(lambda start, stop: kernel(groups[start:stop]), len(groups), step)
        if whole_planes:
            return parallel_for(lambda start, stop: kernel(_segments(start, stop, 0, self.total)), planes, 1)
        # Equal parts, each with its own interleaved planes, are faster; packed planes are never interleaved.
        equal = -(-self.total // (torch.get_num_threads() * memory.BLOCK)) * memory.BLOCK
        chunk = _CHUNK if packed else max(_CHUNK, equal)
        return parallel_for(lambda start, stop: kernel(_segments(0, planes, start, stop)), self.total, chunk)

    def incoming(self, gradient: Tensor) -> tuple[np.ndarray, tuple[int, ...]]:
        """A gradient (point, view, channel) as the kernels read it: memory and strides."""
        if self.position is None:
            return memory.strided(gradient)
        flat = np.zeros((gradient.shape[2], self.total), memory.number(gradient))
        flat[:, self.position] = gradient.detach().numpy().transpose(2, 0, 1).reshape(len(flat), self.position.size)
        return flat.reshape(-1), (1, 0, self.total)


def _rows(points: Tensor, pitch: int) -> np.ndarray:
    """Points as rows of x, y and z; by NumPy, since starting PyTorch's threads would take longer."""
    rows = np.zeros((3, pitch), memory.number(points))
    rows[:, : len(points)] = points.detach().numpy().T
    return rows


def _segments(first: int, last: int, begin: int, end: int) -> np.ndarray:
    """Points begin..end on each of the planes first..last."""
    views = np.arange(first, last)
    return np.stack([views, np.full_like(views, begin), np.full_like(views, end)], 1)


def _grouped(views: np.ndarray, planes: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Segments of points sorted by plane, each starting a new block; the place of each point; the length of a row."""
    order, count = np.argsort(views, kind="stable"), np.bincount(views, minlength=planes)
    padded = -(-count // memory.BLOCK) * memory.BLOCK
    begin = padded.cumsum() - padded
    position = np.empty(len(views), np.int64)
    position[order] = np.arange(len(views)) + (begin - (count.cumsum() - count))[views[order]]
    segments = np.stack([np.arange(planes), begin, begin + count], 1)
    return np.ascontiguousarray(segments[count > 0]), position, int(padded.sum())


@_operator("lookup", f"({_PLANES}, float background) -> (Tensor, Tensor, Tensor)")
def lookup(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None,
    nearest: float, background: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Colours (point, view, channel), coordinates (point, view, 2) and validity (point, view), planar in memory."""
    check_lookup(points, matrices, images, packed, bits, views)
    results = _empty(points, images, views)
    if not results[2].numel():
        return results
    where, number = _Points.projected(points, matrices, views), memory.number(points)
    if views is None:
        outputs = [memory.flat(value) for value in (*results[:2], results[2].view(torch.uint8))]
    else:
        sizes, kinds = (images.shape[1], 2, 1), (number, number, np.uint8)
        outputs = [np.empty(size * where.total, kind) for size, kind in zip(sizes, kinds, strict=True)]
    kernel = compile_kernel("lookup.forward.forward", points.dtype, "projected")
    fixed = (*where.arguments, *memory.planes(images, packed, bits), number(background), number(nearest), *outputs)
    where.run(lambda part: kernel(*fixed, views is not None, part), len(images), False, packed is not None)
    if views is not None:
        for result, output in zip(results, outputs, strict=True):
            found = output.reshape(-1, where.total)[:, where.position].reshape(-1, *views.shape)
            result.copy_(torch.from_numpy(found).permute(1, 2, 0).reshape(result.shape))
    return results


@_operator("lookup_backward", f"({_PLANES}, {_GRADIENTS}) -> (Tensor, Tensor, Tensor)")
def lookup_backward(
    points: Tensor, matrices: Tensor, images: Tensor, packed: Tensor | None, bits: int, views: Tensor | None,
    nearest: float, grad_colours: Tensor | None, grad_coordinates: Tensor | None, geometry: bool, pixels: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to points, matrices and images; empty where not asked for."""
    check_lookup(points, matrices, images, packed, bits, views)
    shape = (len(points), len(images) if views is None else views.shape[1])
    check_gradient("grad_colours", grad_colours, (*shape, images.shape[1]), points)
    check_gradient("grad_coordinates", grad_coordinates, (*shape, 2), points)
    grad_points, grad_matrices = (value.new_zeros(value.shape if geometry else 0) for value in (points, matrices))
    memory_, grad_images = memory.pixel_gradient(images) if pixels else (None, points.new_empty(0))
    if not (shape[0] and shape[1]):
        return grad_points, grad_matrices, grad_images
    zero = points.new_zeros(())
    where = _Points.projected(points, matrices, views)
    colour = where.incoming(zero.expand(*shape, images.shape[1]) if grad_colours is None else grad_colours)
    if geometry:
        coordinate = where.incoming(zero.expand(*shape, 2) if grad_coordinates is None else grad_coordinates)
        rows = np.zeros_like(where.arguments[0])
        planes = memory.planes(images, packed, bits)
        sums = _backward(where, planes, nearest, colour, coordinate, rows, len(matrices), packed is not None)
        rows = rows.reshape(3, -1)
        if where.position is not None:
            rows = rows[:, where.position].reshape(3, *shape).sum(2)
        grad_points = torch.from_numpy(np.ascontiguousarray(rows[:, : len(points)].T))
        grad_matrices = torch.from_numpy(sums).to(matrices).reshape(matrices.shape)
    if memory_ is not None:
        _image_backward(where, images, nearest, colour, memory_)
    return grad_points, grad_matrices, grad_images


@_operator("sample", f"({_SAMPLED}, float background) -> Tensor")
def sample(images: Tensor, coordinates: Tensor, packed: Tensor | None, bits: int, background: float) -> Tensor:
    """Colours (point, view, channel), planar in memory."""
    check_sample(images, coordinates, packed, bits)
    colours = _planar(coordinates, coordinates.shape[1], images.shape[1])
    if colours.numel():
        where, number = _Points.given(coordinates), memory.number(coordinates)
        kernel = compile_kernel("lookup.forward.forward", coordinates.dtype, "given")
        fixed = (*where.arguments, *memory.planes(images, packed, bits), number(background), number(0))
        fixed += (memory.flat(colours), np.zeros(0, number), np.zeros(0, np.uint8), False)
        where.run(lambda part: kernel(*fixed, part), len(images), False, packed is not None)
    return colours


@_operator("sample_backward", f"({_SAMPLED}, Tensor grad_colours, bool geometry, bool pixels) -> (Tensor, Tensor)")
def sample_backward(
    images: Tensor, coordinates: Tensor, packed: Tensor | None, bits: int, grad_colours: Tensor, geometry: bool,
    pixels: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradients with respect to images and coordinates; empty where not asked for."""
    check_sample(images, coordinates, packed, bits)
    check_gradient("grad_colours", grad_colours, (*coordinates.shape[:2], images.shape[1]), coordinates)
    memory_, grad_images = memory.pixel_gradient(images) if pixels else (None, images.new_empty(0))
    if not grad_colours.numel():
        return grad_images, coordinates.new_zeros(coordinates.shape if geometry else 0)
    where = _Points.given(coordinates)
    colour = where.incoming(grad_colours)
    grad_coordinates = _planar(coordinates, len(images), 2) if geometry else coordinates.new_empty(0)
    if geometry:
        none = where.incoming(coordinates.new_zeros(()).expand(coordinates.shape))
        planes = memory.planes(images, packed, bits)
        _backward(where, planes, 0.0, colour, none, memory.flat(grad_coordinates), 0, packed is not None)
    if memory_ is not None:
        _image_backward(where, images, 0.0, colour, memory_)
    return grad_images, grad_coordinates


def _backward(
    where: _Points, planes: tuple[Any, ...], nearest: float, colour: Any, coordinate: Any, result: np.ndarray,
    matrices: int, packed: bool,
) -> np.ndarray:  # fmt: skip
    """Fills the gradient of points or coordinates; returns that of the matrices, (view, 12)."""
    kernel = compile_kernel("lookup.backward.backward", where.like.dtype, where.kind)
    fixed = (*where.arguments, *planes, memory.number(where.like)(nearest), *colour, *coordinate, result)

    def work(part: np.ndarray) -> np.ndarray:
        sums = np.zeros((matrices, 12))
        kernel(*fixed, sums, part)
        return sums

    return sum(where.run(work, len(planes[0]), False, packed), np.zeros((matrices, 12)))


def _image_backward(where: _Points, images: Tensor, nearest: float, colour: Any, result: np.ndarray) -> None:
    """Fills the memory of the gradient of images."""
    kernel = compile_kernel("lookup.backward.image_backward", where.like.dtype, where.kind)
    fixed = (*where.arguments, *images.shape[2:], memory.number(where.like)(nearest), *colour)
    fixed += (images.shape[1], memory.pixel_pitch(images.shape[1]), result)
    where.run(lambda part: kernel(*fixed, part), len(images), True)


def _empty(points: Tensor, images: Tensor, views: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Outputs of a lookup."""
    slots = len(images) if views is None else views.shape[1]
    valid = memory.uninitialised(points, (slots, memory.pitch(points)), torch.bool).T[: len(points)]
    return _planar(points, slots, images.shape[1]), _planar(points, slots, 2), valid


def _planar(points: Tensor, slots: int, numbers: int) -> Tensor:
    """Memory (view, number, point) in rows of whole blocks, as a tensor (point, view, number)."""
    shape = (slots, numbers, memory.pitch(points))
    return memory.uninitialised(points, shape, points.dtype).permute(2, 0, 1)[: len(points)]


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    points, matrices, images, packed, bits, views, nearest, _ = inputs
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[-1])
    ctx.save_for_backward(points, matrices, images, packed, views)
    ctx.bits, ctx.nearest = bits, nearest


def _gradients(
    ctx: Any, grad_colours: Tensor | None, grad_coordinates: Tensor | None, _: None
) -> tuple[Tensor | None, ...]:
    points, matrices, images, packed, views = ctx.saved_tensors
    geometry, pixels = ctx.needs_input_grad[0] or ctx.needs_input_grad[1], ctx.needs_input_grad[2]
    if grad_colours is None and grad_coordinates is None:
        return (None,) * 8
    wanted = ctx.needs_input_grad[:3]
    if torch.is_grad_enabled():
        outputs = lookup_torch.lookup(points, matrices, images, views, 0.0, ctx.nearest)[:2]
        found = _plain_gradients(outputs, (points, matrices, images), wanted, (grad_colours, grad_coordinates))
        return *found, *(None,) * 5
    found = lookup_backward(
        points, matrices, images, packed, ctx.bits, views, ctx.nearest, grad_colours, grad_coordinates, geometry, pixels
    )
    return *(value if needed else None for value, needed in zip(found, wanted, strict=True)), *(None,) * 5


def _sample_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    images, coordinates, packed, bits, _ = inputs
    ctx.save_for_backward(images, coordinates, packed)
    ctx.bits = bits


def _sample_gradients(ctx: Any, grad_colours: Tensor) -> tuple[Tensor | None, ...]:
    images, coordinates, packed = ctx.saved_tensors
    pixels, geometry = ctx.needs_input_grad[:2]
    if torch.is_grad_enabled():
        output = lookup_torch.sample(images, coordinates, 0.0)
        found = _plain_gradients((output,), (images, coordinates), (pixels, geometry), (grad_colours,))
        return *found, None, None, None
    found = sample_backward(images, coordinates, packed, ctx.bits, grad_colours, geometry, pixels)
    return found[0] if pixels else None, found[1] if geometry else None, None, None, None


def _plain_gradients(
    outputs: tuple[Tensor, ...], inputs: tuple[Tensor, ...], wanted: Sequence[bool], pulls: tuple[Tensor | None, ...]
) -> list[Tensor | None]:
    """Gradients that can be differentiated again (`create_graph`), by autograd through the plain backend."""
    pairs = [(out, pull) for out, pull in zip(outputs, pulls, strict=True) if pull is not None and out.requires_grad]
    leaves = [value for value, needed in zip(inputs, wanted, strict=True) if needed]
    if not pairs or not leaves:
        return [None] * len(inputs)
    results = [list(each) for each in zip(*pairs, strict=True)]
    found = iter(torch.autograd.grad(results[0], leaves, results[1], create_graph=True, allow_unused=True))
    return [next(found) if needed else None for needed in wanted]


def _fake_image_gradient(images: Tensor, like: Tensor, pixels: bool) -> Tensor:
    """The gradient of images as `memory.pixel_gradient` lays it out."""
    count, channels, height, width = images.shape
    if not pixels:
        return like.new_empty(0)
    if like.device.type != "cpu":
        return like.new_empty(images.shape)
    pixel = like.new_empty(count, height, width, memory.pixel_pitch(channels))
    return pixel[..., :channels].permute(0, 3, 1, 2)


@torch.library.register_fake("hyperplanes::lookup")
def _(points, matrices, images, packed, bits, views, nearest, background):
    return _empty(points, images, views)


@torch.library.register_fake("hyperplanes::lookup_backward")
def _(points, matrices, images, packed, bits, views, nearest, grad_colours, grad_coordinates, geometry, pixels):
    last = _fake_image_gradient(images, points, pixels)
    return *(value.new_empty(value.shape if geometry else 0) for value in (points, matrices)), last


@torch.library.register_fake("hyperplanes::sample")
def _(images, coordinates, packed, bits, background):
    return _planar(coordinates, coordinates.shape[1], images.shape[1])


@torch.library.register_fake("hyperplanes::sample_backward")
def _(images, coordinates, packed, bits, grad_colours, geometry, pixels):
    grad_coordinates = _planar(coordinates, len(images), 2) if geometry else coordinates.new_empty(0)
    return _fake_image_gradient(images, coordinates, pixels), grad_coordinates


torch.library.register_autograd("hyperplanes::lookup", _gradients, setup_context=_setup)
torch.library.register_autograd("hyperplanes::sample", _sample_gradients, setup_context=_sample_setup)


@torch.library.impl("hyperplanes::lookup", "cuda")
def _(points, matrices, images, packed, bits, views, nearest, background):
    from hyperplanes.geometry.kernels.lookup import lookup_triton

    check_lookup(points, matrices, images, None, 0, views)
    return lookup_triton.lookup(points, matrices, images, views, background, nearest)


@torch.library.impl("hyperplanes::lookup_backward", "cuda")
def _(points, matrices, images, packed, bits, views, nearest, grad_colours, grad_coordinates, geometry, pixels):
    from hyperplanes.geometry.kernels.lookup import lookup_triton

    check_lookup(points, matrices, images, None, 0, views)
    return lookup_triton.lookup_backward(
        points, matrices, images, views, grad_colours, grad_coordinates, geometry, pixels, nearest
    )
