"""A differentiable rasteriser of Gaussian splats, compiled for the CPU with numba.

As in "3D Gaussian Splatting" (Kerbl et al., 2023) and its implementation: Gaussians are projected by the local affine
approximation of the perspective, for those beyond the border of the picture by the one near it, dilated by 0.3 square
pixels, and composited front to back, sorted by depth.
"""

from __future__ import annotations

import math
from typing import Any, no_type_check

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.kernels.compiling import compile_function

__all__ = ["render_splats", "rotations_of"]

DILATION = 0.3  # square pixels
LARGEST_ALPHA, SMALLEST_ALPHA = 0.99, 1 / 255
AROUND = 0.15  # of the picture's width and height, how far beyond its border the projection is approximated
DEVIATIONS = 3.0  # extent of a splat from its centre, in standard deviations


def rotations_of(quaternions: Float[Tensor, "splat 4"]) -> Float[Tensor, "splat 3 3"]:
    """The rotations of quaternions, real part first, of any length.

    >>> rotations_of(torch.tensor([[2.0, 0.0, 0.0, 2.0]]))[0].round().tolist()  # a quarter turn about z
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def render_splats(
    means: Float[Tensor, "splat 3"],
    scales: Float[Tensor, "splat 3"],
    quaternions: Float[Tensor, "splat 4"],
    opacities: Float[Tensor, " splat"],
    colours: Float[Tensor, "splat 3"],
    cameras: PinholeCamera,
) -> Float[Tensor, "3 height width"]:
    """The picture of Gaussians over white for one camera, differentiable in all parameters of the Gaussians.

    Args:
        means: in the world.
        scales: standard deviations along the axes of each, in world units.
        quaternions: rotations of these axes, real part first.
        opacities: at the centres, in [0, 1].
        colours: as seen from the camera.
        cameras: a batch of one, without lens distortion.

    Returns:
        RGB.
    """
    height, width = camera.image_size(cameras)
    cameras = camera.to(cameras, means.device, means.dtype)
    pose, matrix = camera.camera_from_world(cameras)[0], camera.intrinsics(cameras)[0]
    local = means @ pose[:3, :3].T + pose[:3, 3]
    with torch.no_grad():
        order = torch.argsort(local[:, 2])
        order = order[local[order, 2] > camera.least_depth(cameras)]
    x, y, z = local[order].unbind(-1)
    across, skew, down = matrix[0, 0], matrix[0, 1], matrix[1, 1]
    centres = torch.stack([(across * x + skew * y) / z + matrix[0, 2], down * y / z + matrix[1, 2]], -1)
    # the axes of each Gaussian in pixels: the Jacobian of the projection times its axes in the camera's frame
    axes = pose[:3, :3] @ rotations_of(quaternions[order]) * scales[order, None]
    slopes = _near_picture(torch.stack([x, y], -1) / z[:, None], matrix, (height, width)).unbind(-1)
    right, below = ((axes[:, row] - slope[:, None] * axes[:, 2]) / z[:, None] for row, slope in enumerate(slopes))
    right, below = across * right + skew * below, down * below
    xx, yy = right.square().sum(-1) + DILATION, below.square().sum(-1) + DILATION
    xy = (right * below).sum(-1)
    determinant = xx * yy - xy.square()
    conics = torch.stack([yy / determinant, -xy / determinant, xx / determinant], -1)
    reach = DEVIATIONS * torch.maximum(xx, yy).detach().sqrt()
    picture: Tensor = _Rasterise.apply(  # type: ignore[no-untyped-call]
        centres, conics, opacities[order], colours[order], reach, (height, width)
    )
    return picture.permute(2, 0, 1)


def _near_picture(
    slopes: Float[Tensor, "splat 2"], matrix: Float[Tensor, "3 3"], size: tuple[int, int]
) -> Float[Tensor, "splat 2"]:
    """The slopes x / z and y / z of points, clamped to those of the picture and a margin AROUND it.

    The approximation would spread a splat beside the camera, which no ray of the picture meets, over all of it.
    """
    height, width = size
    edges = torch.tensor([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
    down = (edges[:, 1].to(matrix) - matrix[1, 2]) / matrix[1, 1]
    across = (edges[:, 0].to(matrix) - matrix[0, 2] - matrix[0, 1] * down) / matrix[0, 0]
    corners = torch.stack([across, down], -1)
    low, high = corners.amin(0), corners.amax(0)
    margin = AROUND * (high - low)
    return slopes.clamp(low - margin, high + margin)


class _Rasterise(torch.autograd.Function):
    """From splats sorted by depth to a picture (height, width, 3)."""

    @staticmethod
    def forward(
        ctx: Any,
        centres: Tensor,
        conics: Tensor,
        opacities: Tensor,
        colours: Tensor,
        reach: Tensor,
        size: tuple[int, int],
    ) -> Tensor:
        splats = [part.detach().float().contiguous() for part in (centres, conics, reach, opacities, colours)]
        picture, left = torch.zeros(*size, 3), torch.ones(*size)
        compile_function(_forward)(*(part.numpy() for part in splats), picture.numpy(), left.numpy())
        ctx.save_for_backward(*splats, left)
        return picture + left[..., None]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        centres, conics, reach, opacities, colours, left = ctx.saved_tensors
        wrong = gradients[0].float().contiguous()
        behind = (left * wrong.sum(-1)).contiguous()  # the colour behind, in the end white, times the gradient
        found = [torch.zeros_like(part) for part in (centres, conics, opacities, colours)]
        arrays = (centres, conics, reach, opacities, colours, wrong, left.clone(), behind, *found)
        compile_function(_backward)(*(part.numpy() for part in arrays))
        return (*found, None, None)


@no_type_check
def _forward(centres, conics, reaches, opacities, colours, picture, left):
    """Splats from the front to the back; `left` is the transmittance of each pixel."""
    height, width = left.shape
    for splat in range(len(opacities)):
        x, y, reach = centres[splat, 0], centres[splat, 1], reaches[splat]
        a, b, c = conics[splat, 0], conics[splat, 1], conics[splat, 2]
        for row in range(max(0, int(math.ceil(y - reach))), min(height - 1, int(math.floor(y + reach))) + 1):
            for column in range(max(0, int(math.ceil(x - reach))), min(width - 1, int(math.floor(x + reach))) + 1):
                u, v = column - x, row - y
                alpha = opacities[splat] * math.exp(-0.5 * (a * u * u + 2.0 * b * u * v + c * v * v))
                if alpha < SMALLEST_ALPHA:
                    continue
                alpha = min(LARGEST_ALPHA, alpha)
                weight = left[row, column] * alpha
                for channel in range(3):
                    picture[row, column, channel] += weight * colours[splat, channel]
                left[row, column] *= 1.0 - alpha


@no_type_check
def _backward(  # noqa: PLR0913
    centres, conics, reaches, opacities, colours, wrong, left, behind, by_centre, by_conic, by_opacity, by_colour
):
    """Splats from the back to the front, each taken out of `left` again and added to `behind`."""
    height, width = left.shape
    for splat in range(len(opacities) - 1, -1, -1):
        x, y, reach = centres[splat, 0], centres[splat, 1], reaches[splat]
        a, b, c = conics[splat, 0], conics[splat, 1], conics[splat, 2]
        for row in range(max(0, int(math.ceil(y - reach))), min(height - 1, int(math.floor(y + reach))) + 1):
            for column in range(max(0, int(math.ceil(x - reach))), min(width - 1, int(math.floor(x + reach))) + 1):
                u, v = column - x, row - y
                shape = math.exp(-0.5 * (a * u * u + 2.0 * b * u * v + c * v * v))
                alpha = opacities[splat] * shape
                if alpha < SMALLEST_ALPHA:
                    continue
                clipped = alpha > LARGEST_ALPHA
                alpha = min(LARGEST_ALPHA, alpha)
                before = left[row, column] / (1.0 - alpha)
                shown = 0.0
                for channel in range(3):
                    by_colour[splat, channel] += before * alpha * wrong[row, column, channel]
                    shown += colours[splat, channel] * wrong[row, column, channel]
                if not clipped:
                    by_alpha = before * shown - behind[row, column] / (1.0 - alpha)
                    by_opacity[splat] += shape * by_alpha
                    by_power = -0.5 * alpha * by_alpha  # of the quadratic form
                    by_conic[splat, 0] += by_power * u * u
                    by_conic[splat, 1] += by_power * 2.0 * u * v
                    by_conic[splat, 2] += by_power * v * v
                    by_centre[splat, 0] -= by_power * 2.0 * (a * u + b * v)
                    by_centre[splat, 1] -= by_power * 2.0 * (b * u + c * v)
                behind[row, column] += before * alpha * shown
                left[row, column] = before
