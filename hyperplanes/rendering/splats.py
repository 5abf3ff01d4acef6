"""A rasteriser of isotropic Gaussians, as viewers of Gaussian splats draw them, compiled for the CPU by numba.

As in "3D Gaussian Splatting" (Kerbl et al., 2023): Gaussians are projected by the local affine approximation of the
perspective, widened by 0.3 square pixels, and composited front to back in the order of their depths.
"""

from __future__ import annotations

import math
from typing import no_type_check

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.kernels.compiling import compile_function

__all__ = ["render_splats", "splat_gradients"]

DILATION = 0.3  # square pixels
NEAR = 1e-6  # of the scene's unit: what lies nearer to the camera's plane is not drawn
LARGEST_ALPHA, SMALLEST_ALPHA = 0.99, 1 / 255


def render_splats(
    means: Float[Tensor, "splat 3"],
    sizes: Float[Tensor, " splat"],
    opacities: Float[Tensor, " splat"],
    colours: Float[Tensor, "splat 3"],
    cameras: PinholeCamera,
) -> Float[Tensor, "3 height width"]:
    """The picture of Gaussians over white for one camera.

    Args:
        means: in the world.
        sizes: standard deviations in world units.
        opacities: at the centres, in [0, 1].
        colours: as seen from the camera, in [0, 1].
        cameras: a batch of one, without lens distortion.

    Returns:
        RGB.
    """
    return _drawn(means, sizes, opacities, colours, cameras, None)[0]


def splat_gradients(
    means: Float[Tensor, "splat 3"],
    sizes: Float[Tensor, " splat"],
    opacities: Float[Tensor, " splat"],
    colours: Float[Tensor, "splat 3"],
    cameras: PinholeCamera,
    truth: Float[Tensor, "3 height width"],
) -> tuple[float, Float[Tensor, " splat"], Float[Tensor, "splat 3"]]:
    """The mean squared error of `render_splats`, and its gradients with respect to opacities and colours.

    Args:
        means: as there.
        sizes: as there.
        opacities: as there.
        colours: as there.
        cameras: as there.
        truth: the picture as it should be.

    Returns:
        The error and both gradients.
    """
    image, by_opacity, by_colour = _drawn(means, sizes, opacities, colours, cameras, truth)
    number = truth.numel()
    return float((image - truth).square().mean()), by_opacity / number, by_colour / number


@torch.no_grad()
def _drawn(
    means: Tensor,
    sizes: Tensor,
    opacities: Tensor,
    colours: Tensor,
    cameras: PinholeCamera,
    truth: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The picture, and where the truth is given the gradients of the sum of squared errors."""
    pose, matrix = camera.camera_from_world(cameras)[0], camera.intrinsics(cameras)[0]
    height, width = camera.image_size(cameras)
    local = means @ pose[:3, :3].T + pose[:3, 3]
    order = torch.argsort(local[:, 2])
    order = order[local[order, 2] > NEAR]
    x, y, z = local[order].unbind(-1)
    across, down = matrix[0, 0], matrix[1, 1]
    centre = torch.stack([across * x / z + matrix[0, 2], down * y / z + matrix[1, 2]], -1)
    variance = (sizes[order] / z).square()  # times the Jacobian's products
    xx = variance * across**2 * (1 + (x / z).square()) + DILATION
    yy = variance * down**2 * (1 + (y / z).square()) + DILATION
    xy = variance * across * down * (x / z) * (y / z)
    determinant = xx * yy - xy.square()
    shapes = torch.stack([yy / determinant, -xy / determinant, xx / determinant, 3 * torch.maximum(xx, yy).sqrt()], -1)
    arrays = [part.float().contiguous().numpy() for part in (centre, shapes, opacities[order], colours[order])]
    picture = torch.zeros(height, width, 3)
    left = torch.ones(height, width)
    compile_function(_forward)(*arrays, picture.numpy(), left.numpy())
    image = picture + left[..., None]
    by_opacity, by_colour = torch.zeros_like(opacities), torch.zeros_like(colours)
    if truth is not None:
        wrong = 2 * (image - truth.permute(1, 2, 0)).contiguous()
        found = torch.zeros(len(order)), torch.zeros(len(order), 3)
        behind = (left * wrong.sum(-1)).contiguous()  # what lies behind, times the errors
        gradient = compile_function(_backward)
        gradient(*arrays, wrong.numpy(), left.numpy(), behind.numpy(), found[0].numpy(), found[1].numpy())
        by_opacity[order], by_colour[order] = found
    return image.permute(2, 0, 1), by_opacity, by_colour


@no_type_check
def _forward(centres, shapes, opacities, colours, picture, left):
    """Splats from the front to the back; `left` is the transmittance of each pixel."""
    height, width = left.shape
    for splat in range(len(opacities)):
        x, y, reach = centres[splat, 0], centres[splat, 1], shapes[splat, 3]
        for row in range(max(0, int(math.ceil(y - reach))), min(height - 1, int(math.floor(y + reach))) + 1):
            for column in range(max(0, int(math.ceil(x - reach))), min(width - 1, int(math.floor(x + reach))) + 1):
                u, v = column - x, row - y
                power = shapes[splat, 0] * u * u + 2.0 * shapes[splat, 1] * u * v + shapes[splat, 2] * v * v
                alpha = min(LARGEST_ALPHA, opacities[splat] * math.exp(-0.5 * power))
                if alpha < SMALLEST_ALPHA:
                    continue
                weight = left[row, column] * alpha
                for channel in range(3):
                    picture[row, column, channel] += weight * colours[splat, channel]
                left[row, column] *= 1.0 - alpha


@no_type_check
def _backward(centres, shapes, opacities, colours, wrong, left, behind, by_opacity, by_colour):  # noqa: PLR0913
    """Splats from the back to the front, each taken out of `left` again and added to `behind`."""
    height, width = left.shape
    for splat in range(len(opacities) - 1, -1, -1):
        x, y, reach = centres[splat, 0], centres[splat, 1], shapes[splat, 3]
        for row in range(max(0, int(math.ceil(y - reach))), min(height - 1, int(math.floor(y + reach))) + 1):
            for column in range(max(0, int(math.ceil(x - reach))), min(width - 1, int(math.floor(x + reach))) + 1):
                u, v = column - x, row - y
                power = shapes[splat, 0] * u * u + 2.0 * shapes[splat, 1] * u * v + shapes[splat, 2] * v * v
                shape = math.exp(-0.5 * power)
                alpha = min(LARGEST_ALPHA, opacities[splat] * shape)
                if alpha < SMALLEST_ALPHA:
                    continue
                # transmittance before the splat; what it adds to the loss, and what it hides
                before = left[row, column] / (1.0 - alpha)
                shown = 0.0
                for channel in range(3):
                    by_colour[splat, channel] += before * alpha * wrong[row, column, channel]
                    shown += colours[splat, channel] * wrong[row, column, channel]
                if opacities[splat] * shape < LARGEST_ALPHA:
                    by_opacity[splat] += shape * (before * shown - behind[row, column] / (1.0 - alpha))
                behind[row, column] += before * alpha * shown
                left[row, column] = before
