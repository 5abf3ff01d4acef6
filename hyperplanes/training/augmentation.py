"""Augmentation of training objects: rotated about the vertical axis, and in other colours."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views

__all__ = ["Augmentation", "draw_augmentation"]

DARKEST = 0.6  # factor of a colour channel


@dataclass(frozen=True)
class Augmentation:
    """One change of an object, the same for all of its views.

    Attributes:
        angle: in radians, about the vertical axis through the middle of the scene.
        channels: which colour channel each becomes.
        factors: in [0, 1], of each new channel.
    """

    angle: float = 0.0
    channels: tuple[int, int, int] = (0, 1, 2)
    factors: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def views(self, views: Views) -> Views:
        """The views of the object changed so: cameras are rotated with it, and white background stays white.

        Args:
            views: composited over white; without masks all that they show is recoloured.
        """
        changed = replace(views, cameras=_rotated(views, self.angle)) if self.angle else views
        if self._keeps_colours:
            return changed
        background = 0.0 if views.masks is None else 1 - views.masks
        return replace(changed, images=self._recoloured(views.images - background) + background)

    def volume(self, volume: Float[Tensor, "4 x y z"]) -> Float[Tensor, "4 x y z"]:
        """The first channels of a volume (`geometry.volume.volume_of`) of the object changed so.

        Args:
            volume: the share of every cell that is occupied, and its mean colour in [-1, 1]. It is resampled, so that
                the result is smoother than the volume of the changed views.
        """
        changed = _resampled(volume, self.angle) if self.angle else volume
        if self._keeps_colours:
            return changed
        share, colours = changed.split([1, 3])
        colours = self._recoloured((colours + 1).movedim(0, 1)).movedim(1, 0) - 1
        return torch.cat([share, colours * (share > 0)])

    @property
    def _keeps_colours(self) -> bool:
        return self.channels == (0, 1, 2) and self.factors == (1.0, 1.0, 1.0)

    def _recoloured(self, colours: Float[Tensor, "*batch 3 first second"]) -> Tensor:
        return colours[..., list(self.channels), :, :] * colours.new_tensor(self.factors)[:, None, None]


def draw_augmentation(rotations: float, recolouring: float, generator: torch.Generator) -> Augmentation:
    """A random change: any angle, any order of the channels, and factors from DARKEST to 1.

    Args:
        rotations: probability that the object is rotated.
        recolouring: probability that it is recoloured.
        generator: of the draws, which are as many whatever they decide.
    """
    chances, angle = torch.rand(2, generator=generator).tolist(), float(torch.rand((), generator=generator))
    channels = torch.randperm(3, generator=generator).tolist()
    factors = (DARKEST + (1 - DARKEST) * torch.rand(3, generator=generator)).tolist()
    drawn = Augmentation()
    if chances[0] < rotations:
        drawn = replace(drawn, angle=2 * math.pi * angle)
    if chances[1] < recolouring:
        drawn = replace(drawn, channels=tuple(channels), factors=tuple(factors))
    return drawn


def _rotated(views: Views, angle: float) -> PinholeCamera:
    """The cameras of the views, rotated with the object."""
    pose = camera.camera_from_world(views.cameras)
    return camera.with_poses(views.cameras, pose @ torch.linalg.inv(_rotation(angle, views.bounds)).to(pose))


def _rotation(angle: float, bounds: Sphere) -> Float[Tensor, "4 4"]:
    """The rigid motion about the vertical axis through the centre of a sphere, in float64."""
    x, y, z = bounds.centre
    cos, sin = math.cos(angle), math.sin(angle)
    rows = [[cos, 0, sin, x - cos * x - sin * z], [0, 1, 0, 0], [-sin, 0, cos, z + sin * x - cos * z], [0, 0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


def _resampled(volume: Float[Tensor, "4 x y z"], angle: float) -> Float[Tensor, "4 x y z"]:
    """A volume rotated, its colours weighted by how much of each cell is occupied."""
    cos, sin = math.cos(angle), math.sin(angle)
    inverse = volume.new_tensor([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0]], dtype=torch.float32)
    share, colours = volume.float().split([1, 3])
    weighted = torch.cat([share, colours * share])[None]
    grid = affine_grid(inverse[None], list(weighted.shape), align_corners=False)
    share, colours = grid_sample(weighted, grid, align_corners=False)[0].split([1, 3])
    return torch.cat([share, colours / share.clamp_min(1e-6)]).to(volume)
