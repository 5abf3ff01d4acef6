"""Memory layouts of the CPU kernels: NumPy arrays, flat memory, rows of whole blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "BLOCK",
    "array",
    "flat",
    "number",
    "pitch",
    "pixel_gradient",
    "pixel_pitch",
    "planes",
    "strided",
    "uninitialised",
]

BLOCK = 128  # points that a kernel processes at once


def pitch(points: Tensor) -> int:
    """Length of a row with one number a point: on the CPU, whole blocks of the kernels."""
    return -(-len(points) // BLOCK) * BLOCK if points.device.type == "cpu" else len(points)


def pixel_pitch(channels: int) -> int:
    """Numbers per pixel of an image gradient: three channels are padded to a vector of four."""
    return 4 if channels == 3 else channels


def uninitialised(like: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Uninitialised memory, on the CPU from NumPy, which asks Linux for huge pages: a third of the time to touch it."""
    if like.device.type != "cpu" or torch.compiler.is_compiling() or type(like) is not Tensor:
        return like.new_empty(shape, dtype=dtype)
    return torch.from_numpy(np.empty(shape, str(dtype).removeprefix("torch.")))


def flat(value: Tensor) -> np.ndarray:
    """The whole storage of a tensor, including unused memory."""
    return value.new_empty(0).set_(value.untyped_storage()).numpy()


def strided(value: Tensor) -> tuple[np.ndarray, tuple[int, ...]]:
    """The memory from a tensor's first to its last element, and its strides."""
    span = 1 + sum((size - 1) * stride for size, stride in zip(value.shape, value.stride(), strict=True))
    return value.detach().as_strided((span if value.numel() else 0,), (1,)).numpy(), value.stride()


def array(tensor: Tensor) -> np.ndarray:
    """A tensor as a contiguous NumPy array."""
    return tensor.detach().contiguous().numpy()


def number(like: Tensor) -> type[np.floating[Any]]:
    """The NumPy scalar type of a tensor."""
    return np.float64 if like.dtype == torch.float64 else np.float32


def planes(images: Tensor, packed: Tensor | None, bits: int) -> tuple[Any, ...]:
    """Images, the same packed or an empty array, bits per channel or 0, height and width."""
    words = np.zeros(0, np.uint32) if packed is None else array(packed).reshape(-1).view(np.uint32)
    return array(images), words, bits if packed is not None else 0, images.shape[2], images.shape[3]


def pixel_gradient(images: Tensor) -> tuple[np.ndarray, Tensor]:
    """Zeros for the gradient of images in the layout of the kernels, and a view of it as (view, channel, row, column).

    Pixels lie side by side in memory, their channels padded to `pixel_pitch`, with one spare pixel at the end.
    """
    count, channels, height, width = images.shape
    room = pixel_pitch(channels)
    memory = np.zeros((count * height * width + 1) * room, str(images.dtype).removeprefix("torch."))
    pixels = torch.from_numpy(memory)[: memory.size - room].reshape(count, height, width, room)
    return memory, pixels[..., :channels].permute(0, 3, 1, 2)
