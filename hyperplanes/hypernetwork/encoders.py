"""Encoders: a code for each image."""

from __future__ import annotations

from typing import Literal, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import relu

from hyperplanes.hypernetwork.synchronisation import BatchNorm2d

__all__ = ["ENCODERS", "Choice", "ConvNet", "Encoder", "Normalisation", "ResNet101", "encode_objects"]

Choice: TypeAlias = Literal["farthest", "first"]
"""Which k of n planes an encoder reads."""

Encoder: TypeAlias = Literal["convnet", "resnet101"]

Normalisation: TypeAlias = Literal["batch", "batch_statistics", "group"]

CONVOLUTION_CHANNELS = (32, 64, 128, 128)  # of the convolutions of `ConvNet`


def _normalisation(name: Normalisation, channels: int) -> nn.Module:
    if name == "batch":
        return BatchNorm2d(channels)
    if name == "batch_statistics":
        return BatchNorm2d(channels, track_running_stats=False)
    return nn.GroupNorm(8, channels)


class ConvNet(nn.Module):
    """3x3 convolutions, each followed by normalisation and ReLU, halving the image (HyperPlanes, Appendix B)."""

    def __init__(self, code: int, normalisation: Normalisation = "batch") -> None:
        super().__init__()
        sizes = (3, *CONVOLUTION_CHANNELS)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, 3, stride=2, padding=1, bias=False)
            for before, after in zip(sizes, CONVOLUTION_CHANNELS, strict=False)
        )
        self.normalisations = nn.ModuleList(_normalisation(normalisation, after) for after in CONVOLUTION_CHANNELS)
        self.pool = nn.AdaptiveAvgPool2d(4)
        self.code = nn.Linear(CONVOLUTION_CHANNELS[-1] * 16, code)

    def forward(self, images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "view code"]:
        """One code per image; images in [0, 1] of any size."""
        value = 1 - images  # makes the white background zero
        for convolution, normalisation in zip(self.convolutions, self.normalisations, strict=True):
            value = relu(normalisation(convolution(value)))
        return self.code(self.pool(value).flatten(1))


class _Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions with a shortcut (He et al. 2016, Fig. 5).

    The 3x3 convolution has the stride, as in torchvision (ResNet v1.5); in the publication it is the first 1x1.
    """

    def __init__(self, before: int, narrow: int, stride: int, normalisation: Normalisation) -> None:
        super().__init__()
        after = 4 * narrow
        self.path = nn.Sequential(
            nn.Conv2d(before, narrow, 1, bias=False),
            _normalisation(normalisation, narrow),
            nn.ReLU(),
            nn.Conv2d(narrow, narrow, 3, stride, 1, bias=False),
            _normalisation(normalisation, narrow),
            nn.ReLU(),
            nn.Conv2d(narrow, after, 1, bias=False),
            _normalisation(normalisation, after),
        )
        self.shortcut = nn.Identity()
        if stride != 1 or before != after:
            self.shortcut = nn.Sequential(
                nn.Conv2d(before, after, 1, stride, bias=False), _normalisation(normalisation, after)
            )

    def forward(self, value: Tensor) -> Tensor:
        return relu(self.path(value) + self.shortcut(value))


class ResNet101(nn.Module):
    """ResNet-101 with an output of a given size (He et al. 2016; HyperPlanes, Appendix B)."""

    def __init__(
        self, code: int, normalisation: Normalisation = "batch", blocks: tuple[int, ...] = (3, 4, 23, 3)
    ) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, 64, 7, 2, 3, bias=False), _normalisation(normalisation, 64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        )
        stages, before = [], 64
        for stage, count in enumerate(blocks):
            narrow = 64 << stage
            for block in range(count):
                stages.append(_Bottleneck(before, narrow, 2 if block == 0 and stage else 1, normalisation))
                before = 4 * narrow
        self.stages = nn.Sequential(*stages)
        self.code = nn.Linear(before, code)

    def forward(self, images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "view code"]:
        """One code per image; images in [0, 1] of any size."""
        return self.code(self.stages(self.stem(1 - images)).mean((2, 3)))


ENCODERS: dict[str, type[nn.Module]] = {"convnet": ConvNet, "resnet101": ResNet101}


def encode_objects(
    encoder: nn.Module,
    images: Float[Tensor, "object view 3 height width"],
    present: Bool[Tensor, "object view"] | None = None,
    *,
    apart: bool,
) -> Float[Tensor, "object view code"]:
    """The codes of the images of several objects.

    Args:
        encoder: one of ENCODERS.
        images: in [0, 1].
        present: mask of the images to encode, by default all; the others are left out of batch statistics too.
        apart: whether each object is a batch of its own; otherwise all images are one batch.

    Returns:
        Codes, zero for images that are not encoded.
    """
    if present is None:
        present = torch.ones(images.shape[:2], dtype=torch.bool, device=images.device)
    # missing images are not encoded
    batches = [each[there] for each, there in zip(images, present, strict=True)]
    codes = [encoder(batch) for batch in (batches if apart else [torch.cat(batches)])]
    # their codes are zeros
    found = torch.cat(codes)
    return found.new_zeros(*present.shape, found.shape[1]).masked_scatter(present[..., None], found)
