"""Random augmentation of training objects: rotations, plane dropout and background colours."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from hyperplanes.adaptation.alignment.rotation import Rotation
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.rendering.compositing import Rendered

__all__ = ["draw_rotation", "drop_planes", "over_random_colour", "rotated_volume"]


def draw_rotation(share: float, generator: torch.Generator) -> Rotation:
    """A random rotation.

    Args:
        share: probability of a rotation by a uniformly random angle; otherwise the rotation is the identity.
        generator: the generator of two random numbers, which are always drawn.
    """
    chance, angle = torch.rand(2, generator=generator).tolist()
    return Rotation(2 * math.pi * angle) if chance < share else Rotation()


def drop_planes(prepared: SupportContext, chance: float, generator: torch.Generator) -> SupportContext:
    """The object with each plane masked with probability `chance`; if that is 0, nothing is drawn."""
    if not chance:
        return prepared
    hidden = torch.rand(len(prepared.views), generator=generator) < chance
    return prepared.mask_views(hidden.nonzero()[:, 0])


def over_random_colour(
    rendered: Rendered, truth: Float[Tensor, "ray 3"], opacity: Float[Tensor, "ray 1"], generator: torch.Generator
) -> tuple[Rendered, Float[Tensor, "ray 3"]]:
    """Prediction and truth composited over one random colour.

    Args:
        rendered: the prediction, over white.
        truth: the true colours, over white.
        opacity: the true opacities.
        generator: the generator of the colour.
    """
    colour = torch.rand(3, generator=generator).to(truth)
    return rendered.over(colour), truth + (1 - opacity) * (colour - 1)


def rotated_volume(volume: Float[Tensor, "4 x y z"], rotation: Rotation) -> Float[Tensor, "4 x y z"]:
    """The first channels of the volume (`geometry.volume.volume_of`) of a rotated object.

    The volume is resampled, so the result is smoother than the volume of the rotated views.

    Args:
        volume: the share of each cell that is occupied, and its mean colour in [-1, 1]. Colours are weighted by the
            shares when they are resampled.
        rotation: the rotation of the object.
    """
    if not rotation.angle:
        return volume
    cos, sin = math.cos(rotation.angle), math.sin(rotation.angle)
    inverse = volume.new_tensor([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0]], dtype=torch.float32)
    share, colours = volume.float().split([1, 3])
    weighted = torch.cat([share, colours * share])[None]
    grid = affine_grid(inverse[None], list(weighted.shape), align_corners=False)
    share, colours = grid_sample(weighted, grid, align_corners=False)[0].split([1, 3])
    return torch.cat([share, colours / share.clamp_min(1e-6)]).to(volume)
