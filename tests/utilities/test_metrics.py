"""Sources of truth: scikit-image's PSNR and SSIM, and a constant error by hand."""

import math
from importlib import import_module

import numpy as np
import pytest
import torch

from hyperplanes.utilities.images.metrics import foreground_psnr, pooled_psnr, psnr, ssim


@pytest.fixture(scope="module")
def scikit_image():
    """`skimage.metrics`, imported late, because the import takes half a second in each process that collects tests."""
    return import_module("skimage.metrics")


def pairs(size=(24, 31), noise=0.1):
    generator = torch.Generator().manual_seed(0)
    smooth = torch.nn.functional.interpolate(torch.rand(3, 3, 5, 5, generator=generator), size, mode="bicubic")
    truth = smooth.clamp(0, 1)
    truth[1, :, : size[0] // 2] = 1.0  # white background, as rendered objects have
    scale = noise * torch.tensor([0.2, 1.0, 3.0])[:, None, None, None]
    return (truth + scale * torch.randn(truth.shape, generator=generator)).clamp(0, 1), truth


def as_image(image):
    return image.permute(1, 2, 0).double().numpy()


def test_psnr_equals_scikit_images(scikit_image):
    predicted, truth = pairs()
    expected = [
        scikit_image.peak_signal_noise_ratio(as_image(t), as_image(p), data_range=1)
        for p, t in zip(predicted, truth, strict=True)
    ]
    np.testing.assert_allclose(psnr(predicted, truth).numpy(), expected, atol=1e-4)


def test_ssim_equals_scikit_images(scikit_image):
    predicted, truth = pairs()
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = [
        scikit_image.structural_similarity(as_image(t), as_image(p), data_range=1, channel_axis=2, **window)
        for p, t in zip(predicted, truth, strict=True)
    ]
    np.testing.assert_allclose(ssim(predicted, truth).numpy(), expected, atol=1e-5)


def test_a_constant_error_by_hand():
    # an error of 0.1 everywhere: -10 log10(0.01) = 20; of 0.5 in one image of two: -10 log10(0.25) = 6.02
    truth = torch.full((2, 3, 4, 4), 0.5)
    predicted = torch.stack([truth[0] + 0.1, truth[1] - 0.5])
    assert psnr(predicted, truth).tolist() == pytest.approx([20.0, -10 * math.log10(0.25)], abs=1e-4)


def test_equal_images_are_perfect():
    image = pairs()[1]
    assert psnr(image, image).tolist() == [math.inf] * 3
    np.testing.assert_allclose(ssim(image, image).numpy(), 1.0, atol=1e-6)


def test_more_noise_is_worse():
    truth = pairs()[1]
    quality = [(psnr(pairs(noise=n)[0], truth).mean(), ssim(pairs(noise=n)[0], truth).mean()) for n in (0.02, 0.1, 0.3)]
    assert quality[0] > quality[1] > quality[2]
    assert quality[0][1] > quality[1][1] > quality[2][1]


def test_ssim_refuses_images_smaller_than_its_window():
    with pytest.raises(ValueError, match="images: expected at least 11 x 11 pixels, got 10 x 20"):
        ssim(torch.rand(1, 3, 10, 20), torch.rand(1, 3, 10, 20))
    assert torch.isfinite(ssim(torch.rand(1, 3, 11, 11), torch.rand(1, 3, 11, 11))).all()


def test_the_pooled_psnr_is_scikit_images_of_all_pixels(scikit_image):
    predicted, truth = pairs()
    expected = scikit_image.peak_signal_noise_ratio(truth.double().numpy(), predicted.double().numpy(), data_range=1)
    assert pooled_psnr(predicted, truth).item() == pytest.approx(expected, abs=1e-4)
    assert pooled_psnr(predicted, truth) < psnr(predicted, truth).mean()


def test_the_foreground_psnr_counts_pixels_of_the_mask_alone():
    predicted, truth = pairs()
    masks = torch.zeros(3, 1, *truth.shape[2:])
    masks[0, :, 3:9, 5:20] = 0.7
    masks[1] = 0.5  # not above one half
    masks[2, :, 4:, 2:] = 1.0
    found = foreground_psnr(predicted, truth, masks)
    parts = [(0, slice(3, 9), slice(5, 20)), (2, slice(4, None), slice(2, None))]
    expected = [psnr(predicted[i : i + 1, :, a, b], truth[i : i + 1, :, a, b]).item() for i, a, b in parts]
    assert found[[0, 2]].tolist() == pytest.approx(expected, abs=1e-4)
    assert found[1].isnan()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("measure", [psnr, ssim, pooled_psnr])
def test_pictures_of_different_shapes_are_refused(measure):
    with pytest.raises(ValueError, match=r"predicted: expected the shape of the truth, \(2, 3, 12, 12\), got \(1,"):
        measure(torch.rand(1, 3, 12, 12), torch.rand(2, 3, 12, 12))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", [(1, 1, 12, 12), (2, 1, 24, 24)])
def test_masks_of_other_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"masks: expected one an image, \(2, 1, 12, 12\), got"):
        foreground_psnr(torch.rand(2, 3, 12, 12), torch.rand(2, 3, 12, 12), torch.ones(shape))


@pytest.mark.parametrize("metric", [psnr, pooled_psnr, ssim, lambda p, t: foreground_psnr(p, t, t[:, :1])])
def test_images_of_0_to_255_are_refused(metric):
    predicted, truth = pairs()
    with pytest.raises(ValueError, match=r"truth: expected finite numbers in \[0, 1\], got 0 to .*divide 8-bit pixels"):
        metric(predicted, truth * 255)


def test_psnr_works_under_function_transforms():
    predicted, truth = pairs()
    single = torch.func.vmap(lambda p, t: psnr(p[None], t[None])[0])(predicted, truth)
    torch.testing.assert_close(single, psnr(predicted, truth))
