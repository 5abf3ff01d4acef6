"""Images packed into 32 bits a pixel, so that one memory access fetches a pixel's three channels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32
from torch import Tensor

__all__ = ["PackedImages", "pack"]


@dataclass(frozen=True)
class PackedImages:
    """Three-channel images, one 32-bit word a pixel, the first channel in the lowest bits.

    Attributes:
        words: the pixels.
        bits: 8 for eight bits a channel; 11 for eleven, eleven and ten.
    """

    words: Int32[Tensor, "view height width"]
    bits: int


@torch.no_grad()
def pack(images: Float[Tensor, "view channel height width"]) -> PackedImages | None:
    """The images in the better of the two formats, or None where they cannot be packed.

    8-bit images are represented exactly, all others to within 1/2046, a quarter of the 1/512 that the lookup promises.

    Args:
        images: any float dtype.

    Returns:
        None for values outside [0, 1] or not finite, and for anything but three channels.
    """
    if images.shape[1] != 3 or not images.numel():
        return None
    least, most = torch.aminmax(images)
    if not (least >= 0 and most <= 1):
        return None
    # one view after the other: the temporaries of all take several times their memory
    bits = 8 if all(_is_eight_bits(view) for view in images) else 11
    words = torch.empty(images[:, 0].shape, dtype=torch.int32, device=images.device)
    for view, image in zip(words, images, strict=True):
        view.copy_(_words(image, bits))
    return PackedImages(words, bits)


def _is_eight_bits(image: Tensor) -> bool:
    scaled = image.float() * 255
    return bool((scaled - scaled.round()).abs().max() < 1e-2)


def _words(image: Float[Tensor, "channel height width"], bits: int) -> Int32[Tensor, "height width"]:
    widths = bits, bits, bits if bits == 8 else bits - 1
    steps = image.new_tensor([(1 << width) - 1 for width in widths], dtype=torch.float32)
    whole = (image.float() * steps[:, None, None]).round().to(torch.int32)
    return whole[0] | (whole[1] << bits) | (whole[2] << 2 * bits)
