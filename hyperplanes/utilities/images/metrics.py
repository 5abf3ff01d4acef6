"""Image metrics: PSNR of each image, of all together, of the object alone, and SSIM."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.utilities.images.image_range import check_image_range
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["foreground_psnr", "pooled_psnr", "psnr", "ssim"]


@checked
def psnr(
    predicted: Float[Tensor, "view 3 height width"], truth: Float[Tensor, "view 3 height width"]
) -> Float[Tensor, " view"]:
    """Peak signal-to-noise ratio in dB of each image, both in [0, 1]: -10 log10 of the mean squared error.

    Equal images give infinity. Images of different shapes, or a truth far outside [0, 1], are a ValueError.

    >>> psnr(torch.full((1, 3, 4, 4), 0.6), torch.full((1, 3, 4, 4), 0.5)).round().tolist()
    [20.0]
    """
    _check(predicted, truth)
    return -10 * torch.log10((predicted - truth).square().flatten(1).mean(1))


@checked
def pooled_psnr(
    predicted: Float[Tensor, "view 3 height width"], truth: Float[Tensor, "view 3 height width"]
) -> Float[Tensor, ""]:
    """PSNR in dB of the squared error of all images together; never above the mean of `psnr`.

    Images of different shapes, or a truth far outside [0, 1], are a ValueError.

    >>> truth = torch.zeros(2, 3, 4, 4)
    >>> round(pooled_psnr(truth + torch.tensor([0.1, 0.0]).view(2, 1, 1, 1), truth).item(), 2)
    23.01
    """
    _check(predicted, truth)
    return -10 * torch.log10((predicted - truth).square().mean())


@checked
def foreground_psnr(
    predicted: Float[Tensor, "view 3 height width"],
    truth: Float[Tensor, "view 3 height width"],
    masks: Float[Tensor, "view 1 height width"],
) -> Float[Tensor, " view"]:
    """PSNR in dB of each image over the pixels whose true mask is above one half; NaN where there are none.

    White background does not count, so the value does not depend on its area.

    Raises:
        ValueError: images of different shapes, a truth far outside [0, 1], or masks of another size or number.

    >>> truth, masks = torch.zeros(1, 3, 2, 2), torch.tensor([[[[1.0, 0.0], [0.0, 0.0]]]])
    >>> foreground_psnr(truth + torch.tensor([[0.1, 1.0], [1.0, 1.0]]), truth, masks).round(decimals=2).tolist()
    [20.0]
    """
    _check(predicted, truth)
    expected = (len(truth), 1, *truth.shape[2:])
    if masks.shape != expected:
        raise ValueError(f"masks: expected one an image, {expected}, got {tuple(masks.shape)}")
    inside = (masks > 0.5).to(truth)
    error = ((predicted - truth).square().mean(1, keepdim=True) * inside).flatten(1).sum(1)
    return -10 * torch.log10(error / inside.flatten(1).sum(1))


@checked
def ssim(
    predicted: Float[Tensor, "view 3 height width"], truth: Float[Tensor, "view 3 height width"]
) -> Float[Tensor, " view"]:
    """Structural similarity of each image: Gaussian window of 11 pixels, sigma 1.5, mean where it lies in the image.

    Equals scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False)`.

    Raises:
        ValueError: images of different shapes or smaller than the window, or a truth far outside [0, 1].
    """
    from kornia.metrics import ssim as kornia_ssim

    _check(predicted, truth)
    if min(truth.shape[2:]) < 11:
        raise ValueError(f"images: expected at least 11 x 11 pixels, got {truth.shape[2]} x {truth.shape[3]}")
    return kornia_ssim(predicted, truth, 11, padding="valid").flatten(1).mean(1)


def _check(predicted: Tensor, truth: Tensor) -> None:
    """Require equal shapes, as others would be broadcast silently, and a truth in [0, 1]."""
    if predicted.shape != truth.shape:
        raise ValueError(
            f"predicted: expected the shape of the truth, {tuple(truth.shape)}, got {tuple(predicted.shape)}"
        )
    check_image_range("truth", truth.nan_to_num(posinf=torch.inf, neginf=-torch.inf))  # NaN gives a score of NaN
