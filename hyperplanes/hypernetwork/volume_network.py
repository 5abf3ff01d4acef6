"""The network that reads what all views show on a coarse grid, and writes features of every cell."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, silu

__all__ = ["VolumeNetwork"]

FOLD = 2  # cells an axis that become channels before the first convolution
GROUPS = 8  # of the normalisation


class _Residual(nn.Module):
    """A 3x3x3 and a 1x1x1 convolution, each after normalisation and SiLU, beside a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.path = nn.Sequential(
            nn.GroupNorm(GROUPS, channels),
            nn.SiLU(),
            nn.Conv3d(channels, channels, 3, padding=1),
            nn.GroupNorm(GROUPS, channels),
            nn.SiLU(),
            nn.Conv3d(channels, channels, 1),
        )

    def forward(self, value: Tensor) -> Tensor:
        return value + self.path(value)


class VolumeNetwork(nn.Module):
    """A U-Net (Ronneberger et al. 2015; Cicek et al. 2016 in 3D) on a grid.

    Blocks of FOLD cells an axis are channels of one, so that the finest convolutions are those of half the side; the
    features of their cells are unfolded again at the end. The features start at zero.

    Args:
        channels: numbers that are read of a cell.
        side: cells an axis, a multiple of eight.
        features: of every cell.
        widths: channels at half, a quarter and an eighth of the side.

    Raises:
        ValueError: another side.
    """

    def __init__(self, channels: int, side: int, features: int, widths: tuple[int, int, int] = (32, 64, 128)) -> None:
        super().__init__()
        if side % (4 * FOLD):
            raise ValueError(f"side: expected a multiple of {4 * FOLD}, got {side}")
        fine, middle, coarse = widths
        self.features = features
        folded = channels * FOLD**3
        self.first = nn.Conv3d(folded, fine, 1)
        self.downwards = nn.ModuleList([_Residual(fine), _Residual(middle), _Residual(coarse)])
        self.strided = nn.ModuleList(
            [nn.Conv3d(fine, middle, 3, stride=2, padding=1), nn.Conv3d(middle, coarse, 3, stride=2, padding=1)]
        )
        self.upwards = nn.ModuleList([_Residual(coarse), _Residual(middle), _Residual(fine)])
        self.widened = nn.ModuleList([nn.Conv3d(coarse, middle, 1), nn.Conv3d(middle, fine, 1)])
        self.normalisation = nn.GroupNorm(GROUPS, fine)
        self.last = nn.Conv3d(fine + folded, features * FOLD**3, 1)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, volumes: Float[Tensor, "object channel x y z"]) -> Float[Tensor, "object feature x y z"]:
        """The features of every cell for each of several objects."""
        # to half, a quarter and an eighth of the side
        folded = _fold(volumes).contiguous(memory_format=torch.channels_last_3d)
        fine = self.downwards[0](self.first(folded))
        middle = self.downwards[1](self.strided[0](fine))
        coarse = self.downwards[2](self.strided[1](middle))
        # and back to half, each with the features of the same side added
        middle = self.upwards[1](middle + _doubled(self.widened[0](self.upwards[0](coarse))))
        fine = self.upwards[2](fine + _doubled(self.widened[1](middle)))
        # the features of every cell, read beside what the cell showed
        return _unfold(self.last(torch.cat([silu(self.normalisation(fine)), folded], 1)), self.features)


def _doubled(value: Tensor) -> Tensor:
    return interpolate(value, scale_factor=2.0)


def _fold(value: Float[Tensor, "object channel x y z"]) -> Tensor:
    """Blocks of FOLD cells an axis as channels of one cell."""
    side = value.shape[-1] // FOLD
    blocks = value.unflatten(4, (side, FOLD)).unflatten(3, (side, FOLD)).unflatten(2, (side, FOLD))
    return blocks.permute(0, 1, 3, 5, 7, 2, 4, 6).flatten(1, 4)


def _unfold(value: Tensor, channels: int) -> Float[Tensor, "object channel x y z"]:
    """The inverse of `_fold`."""
    blocks = value.unflatten(1, (channels, FOLD, FOLD, FOLD))
    return blocks.permute(0, 1, 5, 2, 6, 3, 7, 4).flatten(6, 7).flatten(4, 5).flatten(2, 3)
