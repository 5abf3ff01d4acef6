"""Points, images and indices from callers: converted to tensors that every backend takes, or refused in one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hyperplanes.utilities.messages.arguments import kind_of

__all__ = [
    "ArrayLike",
    "Selection",
    "as_images",
    "as_indices",
    "as_matrices",
    "as_points",
    "as_selection",
    "as_tensor",
    "check_channels_first",
    "check_indices",
    "check_precision",
]

MOST_COLOURS = 4
"""Most channels of an 8-bit picture: red, green, blue and alpha."""

ArrayLike: TypeAlias = Tensor | npt.NDArray[Any]
"""A tensor, or a NumPy array of the same shape."""


Selection: TypeAlias = slice | Sequence[int] | ArrayLike
"""A selection of several items: a slice, indices, or a boolean for each."""


def as_tensor(name: str, value: ArrayLike) -> Tensor:
    """A tensor as it is, a NumPy array as a tensor on the CPU.

    Raises:
        ValueError: anything else, or numbers that are neither real nor boolean.
    """
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "fiub":
            raise ValueError(f"{name}: expected real numbers, got an array of {value.dtype}")
        value = torch.from_numpy(np.ascontiguousarray(value, value.dtype.newbyteorder("=")))
    if not isinstance(value, Tensor):
        raise ValueError(f"{name}: expected a tensor or a NumPy array, got {type(value).__name__}")
    if value.is_complex():
        raise ValueError(f"{name}: expected real numbers, got {value.dtype}")
    return value


def check_precision(dtype: torch.dtype | None) -> None:
    """Refuse integer and boolean types for real values.

    Args:
        dtype: the type asked for, or None to keep the present one.

    Raises:
        ValueError: an integer or boolean type.
    """
    if dtype is not None and not dtype.is_floating_point:
        raise ValueError(f"dtype: expected a floating-point type, got {dtype}")


def _floating(value: Tensor) -> Tensor:
    return value if value.is_floating_point() else value.to(torch.get_default_dtype())


def as_points(points: ArrayLike) -> Tensor:
    """Points (point, 3) in a floating-point type; integers become PyTorch's default one.

    Raises:
        ValueError: another shape, or not numbers.

    >>> as_points(np.array([[1, 2, 3]])).dtype
    torch.float32
    """
    points = as_tensor("points", points)
    if points.ndim != 2 or points.shape[1] != 3:
        remedy = "; write points[None] for a single point" if points.shape == (3,) else ""
        raise ValueError(f"points: expected shape (point, 3), got {tuple(points.shape)}{remedy}")
    return _floating(points)


def as_matrices(matrices: ArrayLike, views: int) -> Tensor:
    """Projection matrices (view, 3, 4), one a plane.

    Raises:
        ValueError: another shape, or not numbers.
    """
    matrices = as_tensor("matrices", matrices)
    if matrices.shape != (views, 3, 4):
        raise ValueError(
            f"matrices: expected shape ({views}, 3, 4), one K [R | t] an image, got {tuple(matrices.shape)}"
        )
    return matrices


def as_images(images: ArrayLike, name: str = "images", size: tuple[int, int] | None = None) -> Tensor:
    """Images (view, channel, height, width) in a floating-point type; 8-bit ones are divided by 255.

    Args:
        images: what was given.
        name: of the argument, for messages.
        size: (height, width) of their cameras, where it is known.

    Raises:
        ValueError: another number of dimensions, channels last, no pixel, or whole numbers of more than 8 bits.

    >>> as_images(np.full((1, 3, 2, 2), 255, np.uint8)).max()
    tensor(1.)
    """
    axes = "transpose" if isinstance(images, np.ndarray) else "permute"
    values = as_tensor(name, images)
    if values.ndim != 4:
        raise ValueError(f"{name}: expected shape (view, channel, height, width), got {tuple(values.shape)}")
    check_channels_first(name, values, size, axes)
    if len(values) and not (values.shape[2] and values.shape[3]):
        raise ValueError(f"{name}: expected at least one pixel, got {tuple(values.shape)}")
    if values.dtype == torch.uint8:
        return values.to(torch.get_default_dtype()) / 255
    if not values.is_floating_point() and values.dtype != torch.bool:
        raise ValueError(f"{name}: expected floating-point numbers or 8-bit ones, got {values.dtype}")
    return _floating(values)


def check_channels_first(name: str, images: Tensor, size: tuple[int, int] | None = None, axes: str = "permute") -> None:
    """Check that images have PyTorch's order of dimensions, (N, C, H, W).

    As in PyTorch, position alone says which dimension is which; sizes are not guessed from. Channels come last where
    the cameras' size is that of the second and third dimension and not of the last two; without cameras, where 8-bit
    images would have more than four channels, but no more than four in the last dimension.

    Args:
        name: of the argument, for messages.
        images: of four dimensions.
        size: (height, width) of their cameras, where it is known.
        axes: the method that reorders dimensions, for messages.

    Raises:
        ValueError: channels last.

    >>> check_channels_first("images", torch.zeros(2, 16, 40, 3))  # features of 40 x 3 pixels, 16 channels
    >>> check_channels_first("images", torch.zeros(2, 16, 40, 3), (16, 40))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: images: expected channels before rows, (view, channel, height, width), got (2, 16, 40, 3); write ...
    """
    shape = tuple(images.shape)
    if size is None:
        last = images.dtype == torch.uint8 and shape[1] > MOST_COLOURS >= shape[3]
    else:
        last = shape[1:3] == size != shape[2:]
    if last:
        raise ValueError(
            f"{name}: expected channels before rows, (view, channel, height, width), got {shape}; "
            f"write {name}.{axes}(0, 3, 1, 2)"
        )


def as_indices(views: ArrayLike, points: Tensor) -> Tensor:
    """Indices of planes (point, chosen), on the points' device; `check_indices` checks their values.

    Raises:
        ValueError: another shape, or not integers.
    """
    views = as_tensor("views", views)
    if views.is_floating_point() or views.dtype == torch.bool:
        raise ValueError(f"views: expected whole numbers, got {views.dtype}")
    if views.ndim != 2 or len(views) != len(points):
        raise ValueError(f"views: expected shape ({len(points)}, chosen), a row a point, got {tuple(views.shape)}")
    return views.to(points.device, torch.int64)


def as_selection(index: Selection, count: int, name: str) -> slice | Tensor:
    """A selection as a slice or as indices.

    Args:
        index: a slice, indices from -count to count - 1, or a boolean for each item.
        count: number of items.
        name: of the argument, for messages.

    Returns:
        A slice, or indices on the device of `index`.

    Raises:
        ValueError: anything else.

    >>> as_selection([True, False, True], 3, "views")
    tensor([0, 2])
    """
    if isinstance(index, slice):
        return index
    remedy = f"; use [[{index}]]" if isinstance(index, int) else ""
    expected = f"{name}: expected a slice, a list, a tensor or an array of indices (chosen)"
    try:
        chosen = torch.as_tensor(index) if isinstance(index, Sequence | np.ndarray | Tensor) else None
    except (TypeError, ValueError, RuntimeError):
        chosen = None
    if chosen is None or chosen.ndim != 1:
        raise ValueError(f"{expected}, got {kind_of(index)}{remedy}")
    if chosen.dtype == torch.bool:
        if len(chosen) != count:
            raise ValueError(f"{name}: expected {count} booleans, one each, got {len(chosen)}")
        return chosen.nonzero()[:, 0]
    if len(chosen) and (chosen.is_floating_point() or chosen.is_complex()):
        raise ValueError(f"{expected}, got {kind_of(chosen)}")
    chosen = chosen.long()
    if chosen.device.type == "cpu":  # elsewhere it would synchronise
        check_indices(chosen, count, name, name, from_end=True)
    return chosen


def check_indices(
    values: Tensor, count: int, name: str = "views", what: str = "planes", *, from_end: bool = False
) -> None:
    """Check that indices are in range; skipped under `torch.compile` and `torch.func`, where values cannot be read.

    Called once a lookup, right before indexing: one pass over the indices is up to 2 % of its time.

    Args:
        values: the indices.
        count: number of items.
        name: of the argument, for the message.
        what: name of the items, for the message.
        from_end: allow negative indices, which count from the end.

    Raises:
        ValueError: an index out of range.
    """
    if not torch.compiler.is_compiling() and not torch._C._are_functorch_transforms_active() and values.numel():
        least, most = (int(value) for value in torch.aminmax(values))
        if least < (-count if from_end else 0) or most >= count:
            raise ValueError(f"{name}: expected indices of {count} {what}, got {least} to {most}")
