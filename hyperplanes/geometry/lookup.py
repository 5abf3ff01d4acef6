"""Bilinear sampling of images at projected points (`lookup`) or given coordinates (`sample`), by several backends."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hyperplanes.geometry import lookup_torch
from hyperplanes.geometry.inputs import (
    ArrayLike,
    as_images,
    as_indices,
    as_matrices,
    as_points,
    as_tensor,
    check_indices,
)
from hyperplanes.geometry.lookup_torch import MIN_Z
from hyperplanes.geometry.packed_images import PackedImages
from hyperplanes.utilities.messages.arguments import kind_of
from hyperplanes.utilities.messages.formatting import counted
from hyperplanes.utilities.tensors.transforms import transform_of

__all__ = ["Backend", "Lookup", "backends", "choose", "lookup", "sample"]

_INSTALLED = {module: importlib.util.find_spec(module) is not None for module in ("numba", "triton")}


@dataclass(frozen=True)
class Lookup:
    """Colours and coordinates of points on planes.

    Attributes:
        colours: bilinear colours; the background where `valid` is false.
        coordinates: where the point falls on the plane, (column, row) in [-1, 1] from the first pixel's centre to the
            last one's. Clamped to that range for points outside the image, zero for points behind the camera.
        valid: the point is in front of the camera and inside its image: between the centres of the outermost pixels,
            or beyond them by no more than `lookup_torch.BORDER_TOLERANCE`, a hundredth of a pixel, as rounding may
            place a point that lies on them. The colour there is that of the border.
        directions: unit vectors from each camera's centre to the point, in the world, or None.
        distances: from each camera's centre to the point, in world units, or None.
    """

    colours: Float[Tensor, "point view channel"]
    coordinates: Float[Tensor, "point view 2"]
    valid: Bool[Tensor, "point view"]
    directions: Float[Tensor, "point view 3"] | None = None
    distances: Float[Tensor, "point view"] | None = None


@dataclass(frozen=True)
class Backend:
    """An implementation of the lookup.

    Attributes:
        name: value of `backend=`.
        available: whether it can run here.
        reason: why, or what is missing.
    """

    name: str
    available: bool
    reason: str


def backends() -> list[Backend]:
    """All implementations of the lookup, the plain reference first."""
    found = [Backend("torch", True, "plain PyTorch, any device; the reference")]
    if not _INSTALLED["numba"]:
        found.append(Backend("cpu", False, "needs numba: pip install numba"))
    else:
        threads = counted(torch.get_num_threads(), "thread")
        found.append(Backend("cpu", True, f"numba kernels, {threads}; the default on the CPU"))
    if not _INSTALLED["triton"]:
        found.append(Backend("triton", False, "needs triton, which comes with PyTorch for CUDA"))
    elif not torch.cuda.is_available():
        found.append(Backend("triton", False, "needs a CUDA device that PyTorch can see"))
    else:
        name = torch.cuda.get_device_name()
        found.append(Backend("triton", True, f"fused kernels on {name}; the default on CUDA"))
    return found


def choose(points: Tensor, images: Tensor) -> str:
    """The fastest backend for these tensors: that of their device, or plain PyTorch for dtypes and sizes it lacks."""
    if points.dtype not in (torch.float32, torch.float64) or images.shape[2] * images.shape[3] >= 2**31:
        return "torch"
    if points.device.type == "cpu":
        return "cpu" if _INSTALLED["numba"] else "torch"
    return "triton" if points.device.type == "cuda" and _INSTALLED["triton"] else "torch"


def lookup(
    points: ArrayLike,
    matrices: ArrayLike,
    images: ArrayLike,
    views: ArrayLike | None = None,
    *,
    background: float = 1.0,
    nearest: float = MIN_Z,
    packed: PackedImages | None = None,
    backend: str | None = None,
) -> Lookup:
    """Projects every point onto planes and interpolates the colours there.

    Differentiable in points, matrices and images, any number of times: a gradient with `create_graph=True` is computed
    in plain PyTorch, as is everything under forward-mode differentiation and the transforms of `torch.func`, which the
    kernels do not support. With u = M (x, 1), the pixel is (u_0 / u_2, u_1 / u_2) in integer pixel centres.

    Args:
        points: (point, 3) in the world; float32 or float64 for the fast backends. All computations happen in their
            dtype; whole numbers become float32.
        matrices: (view, 3, 4), K [R | t] of each plane.
        images: (view, channel, height, width), any number of channels, none included; 8-bit ones are divided by 255.
        views: (point, chosen), indices of the planes of each point, the only ones that are computed; all planes where
            absent.
        background: colour of points outside an image.
        nearest: z in a camera's frame below which a point counts as behind the camera, in world units.
        packed: the same images in 32 bits a pixel, which the CPU backend reads instead for float32 points when no
            gradient with respect to the images is wanted.
        backend: "torch", "cpu" or "triton"; the fastest that takes these tensors where absent.

    Returns:
        Tensors (point, view, ...), where the second dimension is that of `views` if that is given.

    Raises:
        ValueError: tensors of other shapes or types, an unknown backend, one that is not available or cannot do what
            is asked, or an index in `views` that is out of range.

    >>> ramp = torch.arange(4.0).expand(1, 1, 4, 4)
    >>> matrix = torch.tensor([[[2.0, 0.0, 1.5, 0.0], [0.0, 2.0, 1.5, 0.0], [0.0, 0.0, 1.0, 0.0]]])
    >>> found = lookup(torch.tensor([[0.5, 0.0, 2.0]]), matrix, ramp)
    >>> found.colours.item(), found.valid.item()
    (2.0, True)
    """
    if not isinstance(background, int | float):
        raise ValueError(f"background: expected a number, got {kind_of(background)}")
    points, images = as_points(points), as_images(images)
    matrices, images = as_matrices(matrices, len(images)).to(points), images.to(points)
    views = None if views is None else as_indices(views, points)
    name = backend or choose(points, images)
    if name != "torch" and (unknown := transform_of(points, matrices, images)):
        if backend is not None:
            raise ValueError(f"backend: {backend} has no {unknown}; use backend='torch'")
        name = "torch"
    if name == "torch":
        if views is not None:
            check_indices(views, len(images))
        return Lookup(*lookup_torch.lookup(points, matrices, images, views, background, nearest))
    if backend is not None:
        _check(backend, points.device)
    from hyperplanes.geometry.kernels.lookup import operators

    fits = packed is not None and points.dtype == torch.float32 and not images.requires_grad
    words, bits = (packed.words, packed.bits) if packed is not None and fits else (None, 0)
    return Lookup(*operators.lookup(points, matrices, images, words, bits, views, nearest, background))


def sample(
    images: ArrayLike,
    coordinates: ArrayLike,
    *,
    background: float = 1.0,
    packed: PackedImages | None = None,
    backend: str | None = None,
) -> Float[Tensor, "point view channel"]:
    """Bilinear colours of every image at its own coordinates, interpolated as in `lookup`.

    Coordinates are those of `Lookup.coordinates`, Kornia's `normalize_pixel_coordinates` and `grid_sample` with
    `align_corners=True`: (column, row), -1 at the first pixel's centre, 1 at the last one's; along an axis of one pixel
    all mean that pixel. Outside of [-1, 1], and for NaN, the colour is the background, without gradient; unlike in
    `grid_sample` nothing is blended with it. Differentiable in images and coordinates, as `lookup` is.

    Args:
        images: (view, channel, height, width), any number of channels, none included; 8-bit ones are divided by 255.
        coordinates: (point, view, 2), of any strides; fastest where a view's coordinates lie together in memory, in
            pairs, as the transpose of (view, point, 2), or columns first, as the lookup returns them. All computations
            happen in their dtype, float32 or float64 for the fast backend.
        background: colour outside.
        packed: the same images in 32 bits a pixel, which the CPU backend reads instead for float32 coordinates when no
            gradient with respect to the images is wanted.
        backend: "torch" or "cpu"; the fastest that takes these tensors where absent.

    Returns:
        Colours, planar in memory: (view, channel, point).

    Raises:
        ValueError: images or coordinates of another shape, or a backend that does not take them.

    >>> import torch
    >>> ramp = torch.arange(4.0).expand(1, 1, 4, 4)
    >>> sample(ramp, torch.tensor([[[0.0, 0.0]], [[1.0, -1.0]], [[1.1, 0.0]]]), background=9.0).flatten().tolist()
    [1.5, 3.0, 9.0]
    """
    if not isinstance(background, int | float):
        raise ValueError(f"background: expected a number, got {kind_of(background)}")
    images, coordinates = as_images(images), as_tensor("coordinates", coordinates)
    if not coordinates.is_floating_point():
        coordinates = coordinates.to(torch.get_default_dtype())
    if coordinates.ndim != 3 or coordinates.shape[1:] != (len(images), 2):
        expected = f"(point, {len(images)}, 2), {len(images)} being the number of images"
        raise ValueError(f"coordinates: expected shape {expected}, got {tuple(coordinates.shape)}")
    images = images.to(coordinates)
    fastest = choose(coordinates, images)
    name = backend or ("cpu" if fastest == "cpu" else "torch")
    if name == "cpu" and (unknown := transform_of(images, coordinates)):
        if backend is not None:
            raise ValueError(f"backend: cpu has no {unknown}; use backend='torch'")
        name = "torch"
    if name == "torch":
        return lookup_torch.sample(images, coordinates, background)
    if name != "cpu" or fastest != "cpu":
        taken = f"{str(coordinates.dtype).removeprefix('torch.')} on {coordinates.device}"
        raise ValueError(
            f"backend: expected {'torch' if fastest != 'cpu' else 'torch or cpu'} for {taken}, got {name!r}"
        )
    from hyperplanes.geometry.kernels.lookup import operators

    fits = packed is not None and coordinates.element_size() == 4 and not images.requires_grad
    words, bits = (packed.words, packed.bits) if packed is not None and fits else (None, 0)
    return operators.sample(images, coordinates, words, bits, background)


def _check(name: str, device: torch.device) -> None:
    known = {each.name: each for each in backends()}
    if name not in known:
        raise ValueError(f"backend: expected one of {', '.join(known)}, got {name!r}")
    if not known[name].available:
        raise ValueError(f"backend: {name} {known[name].reason}")
    if device.type != {"cpu": "cpu", "triton": "cuda"}[name]:
        raise ValueError(f"backend: {name} does not take points on {device}")
