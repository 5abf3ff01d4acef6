"""The shapes of hypernetworks, one dataclass for each kind; `docs/hypernetwork.md` has what each choice is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

from torch import Tensor
from torch.nn.functional import relu, silu

from hyperplanes.hypernetwork.encoders import Choice, Encoder, Normalisation
from hyperplanes.utilities.arguments import checked_fields

__all__ = [
    "ACTIVATIONS",
    "KINDS",
    "HyperNetworkConfig",
    "ImageHyperNetworkConfig",
    "VolumeHyperNetworkConfig",
]

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"relu": relu, "silu": silu}


@checked_fields
@dataclass(frozen=True)
class ImageHyperNetworkConfig:
    """A hypernetwork that reads images, as in the paper (`ImageHyperNetwork`).

    Attributes:
        code: length of the code of one image.
        code_normalisation: of the codes: "running" standardises them by running statistics over objects, "none" leaves
            them as they are.
        depth: fully connected layers of the head before its outputs.
        width: of each of them.
        activation: of the head: "relu" as in the paper, or "silu".
        layers: which layers of the target are updated: ("colour", "density") as in the paper, or ("all",).
        update: how outputs become an update: "full" as in the paper, or "low_rank"; see `updates`.
        rank: of "low_rank" updates.
        see_weights: theta is an input.
        weights_seen: how much of it: "updated", the weights of the layers that are updated, or "all". The paper says
            theta. It is the same for every object, so it carries no information about the object; in training it lets
            the update follow the weights it is added to.
        centre: what the output layers read is standardised by running statistics over objects, and they have no bias:
            the update has mean zero over objects, so that what is the same for every object can only go into theta.
        views: k, the number of HyperPlanes it reads; the most it reads with a field that takes any number of views.
        choice: which k of the n planes they are: the "farthest" apart, or the "first".
        resolution: pixels a side that HyperPlanes are resized to before they are encoded, so that pictures of every
            size are read alike; 0 leaves them as they are, and resizes those of a step to the size of its first object.
        encoder: "convnet" (ShapeNet 128) or "resnet101" (ShapeNet 200).
        normalisation: of the encoder: "batch" as in the paper, by running statistics in use; "batch_statistics", by the
            statistics of the HyperPlanes at hand in use too, as the published code does; or "group", image by image.
        join: how the codes of k images become one: "concatenate" as in the paper, or "mean", in which case each code is
            joined with its viewing direction first and the order of the images does not matter.
        see_directions: the viewing directions are an input.
    """

    code: Annotated[int, range(1, 8193)] = 128
    code_normalisation: Literal["none", "running"] = "running"
    depth: Annotated[int, range(1, 257)] = 3
    width: Annotated[int, range(1, 8193)] = 256
    activation: Literal["relu", "silu"] = "relu"
    layers: tuple[str, ...] = ("colour", "density")
    update: Literal["full", "low_rank"] = "full"
    rank: Annotated[int, range(1, 1025)] = 4
    see_weights: bool = True
    weights_seen: Literal["updated", "all"] = "updated"
    centre: bool = True
    views: Annotated[int, range(1, 1025)] = 5
    choice: Choice = "farthest"
    resolution: Annotated[int, range(8193)] = 0
    encoder: Encoder = "convnet"
    normalisation: Normalisation = "batch"
    join: Literal["concatenate", "mean"] = "concatenate"
    see_directions: bool = True


@checked_fields
@dataclass(frozen=True)
class VolumeHyperNetworkConfig:
    """A hypernetwork that reads what all views show on a grid over the scene (`VolumeHyperNetwork`); no settings."""


HyperNetworkConfig: TypeAlias = ImageHyperNetworkConfig | VolumeHyperNetworkConfig

KINDS: dict[str, type[ImageHyperNetworkConfig] | type[VolumeHyperNetworkConfig]] = {
    "images": ImageHyperNetworkConfig,
    "volume": VolumeHyperNetworkConfig,
}
"""By the entry `kind` of files of settings."""
