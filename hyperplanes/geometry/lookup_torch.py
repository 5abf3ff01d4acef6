"""The lookup in plain PyTorch: the reference of the other backends, for any device, dtype and order of derivative."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from hyperplanes.utilities.tensors.transforms import transform_of

__all__ = ["BORDER_TOLERANCE", "MIN_Z", "interpolate", "lookup", "place", "project", "sample"]

MIN_Z = 1e-4  # z in the camera's frame, in units of the scene's scale; points below it count as behind the camera
# pixels beyond the centres of the outermost pixels that still count as inside: projections are rounded
BORDER_TOLERANCE = 0.01


def project(points: Tensor, matrices: Tensor, views: Tensor | None, nearest: float = MIN_Z) -> tuple[Tensor, Tensor]:
    """Pixels (point, view, 2), zero behind the camera, and whether the point is in front (point, view)."""
    if views is None:
        homogeneous = (torch.einsum("vij,pj->vpi", matrices[..., :3], points) + matrices[:, None, :, 3]).transpose(0, 1)
    else:
        chosen = matrices[views]
        homogeneous = torch.einsum("pvij,pj->pvi", chosen[..., :3], points) + chosen[..., 3]
    z = homogeneous[..., 2]
    front = (z > nearest) & (z < torch.inf)
    pixels = homogeneous[..., :2] / torch.where(front, z, 1.0)[..., None]
    return torch.where(front[..., None], pixels, 0.0), front


def place(pixels: Tensor, front: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Clamped coordinates (point, view, 2) in [-1, 1], zero behind the camera, and validity (point, view)."""
    last = pixels.new_tensor([width - 1, height - 1])
    valid = front & ((pixels >= -BORDER_TOLERANCE) & (pixels <= last + BORDER_TOLERANCE)).all(-1)
    highest = 2 * last.clamp_max(1) - 1  # an axis of one pixel has the one coordinate -1
    coordinates = (pixels * (2 / last.clamp_min(1)) - 1).clamp(-torch.ones_like(last), highest)
    return torch.where(front[..., None], coordinates, 0.0), valid


def interpolate(images: Tensor, coordinates: Tensor, views: Tensor | None) -> Tensor:
    """Bilinear colours (point, view, channel) at coordinates in [-1, 1] from pixel centre to pixel centre."""
    if views is None and transform_of(images, coordinates):  # not supported by grid_sample
        views = torch.arange(len(images), device=images.device)[None]
    if views is None:
        grid = coordinates.transpose(0, 1)[:, :, None]
        sampled = grid_sample(images, grid, align_corners=True, padding_mode="border")[..., 0]
        return sampled.permute(2, 0, 1)
    height, width = images.shape[2:]
    pixels = (coordinates + 1) * (0.5 * coordinates.new_tensor([width - 1, height - 1]))
    corner = torch.minimum(pixels.detach().floor(), pixels.new_tensor([max(width - 2, 0), max(height - 2, 0)]))
    fraction = (pixels - corner)[..., None, :]
    x, y = corner.long().unbind(-1)
    right, below = min(width - 1, 1), min(height - 1, 1)
    top_left, top_right = images[views, :, y, x], images[views, :, y, x + right]
    low_left, low_right = images[views, :, y + below, x], images[views, :, y + below, x + right]
    top = torch.lerp(top_left, top_right, fraction[..., 0].expand_as(top_left))
    low = torch.lerp(low_left, low_right, fraction[..., 0].expand_as(top_left))
    return torch.lerp(top, low, fraction[..., 1].expand_as(top))


def sample(images: Tensor, coordinates: Tensor, background: float) -> Tensor:
    """Colours (point, view, channel) at coordinates (point, view, 2); the background outside the images."""
    if not coordinates.numel() or not images.shape[1]:
        return coordinates.new_empty(*coordinates.shape[:2], images.shape[1])
    grid = coordinates.transpose(0, 1)
    (u, v), (height, width) = (0.5 * (grid + 1)).unbind(-1), images.shape[2:]
    u, v = u * (width - 1), v * (height - 1)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    found = interpolate(images, torch.where(inside[..., None], grid, 0.0).transpose(0, 1), None)
    return torch.where(inside[:, None], found.permute(1, 2, 0), background).permute(2, 0, 1)


def lookup(
    points: Tensor,
    matrices: Tensor,
    images: Tensor,
    views: Tensor | None,
    background: float,
    nearest: float = MIN_Z,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (point, view, channel), coordinates (point, view, 2) and validity (point, view)."""
    pixels, front = project(points, matrices, views, nearest)
    coordinates, valid = place(pixels, front, *images.shape[2:])
    if not valid.numel() or not images.shape[1]:
        return points.new_empty(*valid.shape, images.shape[1]), coordinates, valid
    return torch.where(valid[..., None], interpolate(images, coordinates, views), background), coordinates, valid
