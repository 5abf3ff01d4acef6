"""A network from a volume over the scene to features of every cell."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv3d, interpolate, pad, silu

from hyperplanes.utilities.tensors.transforms import are_plain

__all__ = ["VolumeNetwork"]

FOLD = 2  # cells an axis that are folded into channels before the first convolution
WIDTHS = (32, 64, 128)  # channels at half, a quarter and an eighth of the side
GROUPS = 8  # of the normalisation


class _Convolution(nn.Conv3d):
    """A 3x3x3 convolution with zero padding.

    The depth is padded separately: oneDNN, which PyTorch uses for convolutions on CPUs, has a fast weight gradient of
    3D convolutions only without padded depth. For 32 channels on four grids of 16 cells an axis it takes 13 ms instead
    of 24 (one thread, AVX2). For a single small volume PyTorch does not use oneDNN, so it is called directly: forward
    1.2 ms instead of 6.0 for 32 channels on 16 cells an axis (one thread, AVX-512). Backward it is not used.

    Args:
        before: channels of the input.
        after: channels of the output.
        stride: in cells.
    """

    def __init__(self, before: int, after: int, stride: int = 1) -> None:
        super().__init__(before, after, 3, stride, padding=1)

    def forward(self, input: Tensor) -> Tensor:
        """The convolution."""
        if torch.is_autocast_enabled("cpu"):  # in bfloat16 a padded depth is as fast
            return super().forward(input)
        padded = pad(input, (0, 0, 0, 0, 1, 1))
        if len(input) == 1 and _has_onednn(input):
            return torch.mkldnn_convolution(padded, self.weight, self.bias, (0, 1, 1), self.stride, self.dilation, 1)
        return conv3d(padded, self.weight, self.bias, self.stride, (0, 1, 1))


def _has_onednn(value: Tensor) -> bool:
    """Whether oneDNN may be called directly: in float32 on a CPU, outside torch.compile and torch.func."""
    kind = (value.device.type, value.dtype) == ("cpu", torch.float32)
    return kind and torch.backends.mkldnn.is_available() and torch.backends.mkldnn.enabled and are_plain(value)


class _Pointwise(nn.Conv3d):
    """A 1x1x1 convolution as a matrix product, with which forward and backward take two thirds of the time.

    Args:
        before: channels of the input.
        after: of the output.
    """

    def __init__(self, before: int, after: int) -> None:
        super().__init__(before, after, 1)

    def forward(self, *inputs: Tensor) -> Tensor:
        """The convolution of the concatenated inputs, without copying them."""
        assert self.bias is not None
        total, weights = self.bias[:, None], self.weight.flatten(1).split([each.shape[1] for each in inputs], 1)
        for each, weight in zip(inputs, weights, strict=True):
            total = torch.baddbmm(total, weight.expand(len(each), -1, -1), each.flatten(2))
        return total.unflatten(2, inputs[0].shape[2:])


class _Residual(nn.Module):
    """A 3x3x3 and a 1x1x1 convolution, each after normalisation and SiLU, with a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.path = nn.Sequential(
            nn.GroupNorm(GROUPS, channels),
            nn.SiLU(),
            _Convolution(channels, channels),
            nn.GroupNorm(GROUPS, channels),
            nn.SiLU(),
            _Pointwise(channels, channels),
        )

    def forward(self, value: Tensor) -> Tensor:
        return value + self.path(value)


class VolumeNetwork(nn.Module):
    """A U-Net (Ronneberger et al. 2015; Cicek et al. 2016 in 3D) on a grid.

    Blocks of FOLD cells an axis are folded into channels, so that the finest convolutions are at half the resolution,
    and unfolded at the end. Outputs are zero at initialisation.

    Args:
        channels: of the input.
        side: cells an axis, a multiple of eight.
        features: channels of the output.

    Raises:
        ValueError: `side` is not a multiple of eight.
    """

    def __init__(self, channels: int, side: int, features: int) -> None:
        super().__init__()
        if side % (4 * FOLD):
            raise ValueError(f"side: expected a multiple of {4 * FOLD}, got {side}")
        fine, middle, coarse = WIDTHS
        self.features = features
        folded = channels * FOLD**3
        self.first = _Pointwise(folded, fine)
        self.downwards = nn.ModuleList([_Residual(fine), _Residual(middle), _Residual(coarse)])
        self.strided = nn.ModuleList([_Convolution(fine, middle, stride=2), _Convolution(middle, coarse, stride=2)])
        self.upwards = nn.ModuleList([_Residual(coarse), _Residual(middle), _Residual(fine)])
        self.widened = nn.ModuleList([_Pointwise(coarse, middle), _Pointwise(middle, fine)])
        self.normalisation = nn.GroupNorm(GROUPS, fine)
        self.last = _Pointwise(fine + folded, features * FOLD**3)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, volumes: Float[Tensor, "object channel x y z"]) -> Float[Tensor, "object feature x y z"]:
        """The features of every cell, for several objects."""
        # to half, a quarter and an eighth of the side
        folded = _fold(volumes)
        fine = self.downwards[0](self.first(folded))
        middle = self.downwards[1](self.strided[0](fine))
        coarse = self.downwards[2](self.strided[1](middle))
        # and back to half, adding the features of the same side
        middle = self.upwards[1](middle + _doubled(self.widened[0](self.upwards[0](coarse))))
        fine = self.upwards[2](fine + _doubled(self.widened[1](middle)))
        # the output layer also reads the input
        return _unfold(self.last(silu(self.normalisation(fine)), folded), self.features)


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
