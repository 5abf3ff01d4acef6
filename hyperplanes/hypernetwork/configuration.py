"""The shapes of hypernetworks, one dataclass for each kind; docs/hypernetwork.md compares the choices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

from torch import Tensor
from torch.nn.functional import relu, silu

from hyperplanes.hypernetwork.encoders import Choice, Encoder, Normalisation
from hyperplanes.utilities.messages.arguments import checked_fields

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
        code_normalisation: of the codes: "running" standardises them with running statistics over objects, "none"
            leaves them unchanged.
        depth: fully connected layers of the head before its output layers.
        width: of each of them.
        activation: of the head: "relu" as in the paper, or "silu".
        layers: which layers of the target are updated: ("colour", "density") as in the paper, or ("all",).
        update: form of the update: "full" as in the paper, or "low_rank"; see `updates`.
        rank: of "low_rank" updates.
        see_weights: whether theta is an input.
        weights_seen: which part of it: "updated", the weights of the layers that are updated, or "all". The paper says
            theta. It is the same for every object, so it carries no information about the object; in training it lets
            the update follow the weights it is added to.
        centre: whether inputs of the output layers are standardised with running statistics over objects, and these
            layers have no bias. The update then has mean zero over objects, so that only theta can hold what all
            objects share.
        views: k, the number of HyperPlanes it reads; the largest number with a field that takes any number of views.
        choice: which k of the n planes it reads: the "farthest" apart, or the "first".
        resolution: pixels a side that HyperPlanes are resized to before encoding, so that all sizes are read alike; 0
            keeps their size, and resizes all images of a training step to that of its first object.
        encoder: "convnet" (ShapeNet 128) or "resnet101" (ShapeNet 200).
        normalisation: of the encoder: "batch" as in the paper, with running statistics in evaluation;
            "batch_statistics", with those of the current HyperPlanes in evaluation too, as in the published code; or
            "group", per image.
        join: how the codes of k images are combined: "concatenate" as in the paper, or "mean", in which case each code
            is first combined with its viewing direction, and the order of the images does not matter.
        see_directions: whether the viewing directions are an input.
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
    """A hypernetwork that reads all views projected onto a grid over the scene (`VolumeHyperNetwork`); no settings."""


HyperNetworkConfig: TypeAlias = ImageHyperNetworkConfig | VolumeHyperNetworkConfig

KINDS: dict[str, type[ImageHyperNetworkConfig] | type[VolumeHyperNetworkConfig]] = {
    "images": ImageHyperNetworkConfig,
    "volume": VolumeHyperNetworkConfig,
}
"""Configurations by the entry `kind` of settings files."""
