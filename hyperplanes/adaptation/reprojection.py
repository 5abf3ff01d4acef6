"""What support views show at points of a new view: residuals and colours, as weighted means over the views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import ImagePlanes

__all__ = ["CHANNELS", "Reprojected", "nearest_views", "reproject"]

CHANNELS = 8  # of a support view: residual, depth times opacity, opacity, image
ANGULAR_FALLOFF = 10.0  # of weights as a function of 1 - the cosine of the angle between rays: a third at 27 degrees
MAX_COSINE_DISTANCE = 0.5  # value of 1 - cosine from which on the weight is 0: 60 degrees
DISTANCE_SCALE = 0.25  # distance from the surface that a support view sees, in radii, at which the weight is 1 / e
MAX_VIEWS = 8  # that count for a pixel; PSNR as with all, to 0.07 dB (docs/image-based-measurements.md)
DOUBT = 0.1  # weight of a residual of zero
MIN_WEIGHT = 1e-6  # of all views together, below which means are 0
PAIR_CHUNK = 1 << 18  # of a point and a support view, processed at once


@dataclass(frozen=True)
class Reprojected:
    """What support views show at points: weighted means over the views.

    Attributes:
        residual: mean with a residual of zero of weight DOUBT.
        image: mean of the colours of the images; 0 where no view has a weight.
        weight: sum of the weights.
        residual_variance: of the residuals, mean over the channels.
        image_variance: of the colours of the images, mean over the channels.
    """

    residual: Float[Tensor, "*point 3"]
    image: Float[Tensor, "*point 3"]
    weight: Float[Tensor, "*point 1"]
    residual_variance: Float[Tensor, "*point 1"]
    image_variance: Float[Tensor, "*point 1"]

    def map(self, function: Callable[[Tensor], Tensor]) -> Reprojected:
        """A function of each attribute."""
        return Reprojected(*(function(getattr(self, each.name)) for each in fields(self)))


def reproject(
    planes: ImagePlanes,
    chosen: Int[Tensor, "point view"],
    points: Float[Tensor, "point 3"],
    directions: Float[Tensor, "point 3"],
    radius: float,
) -> Reprojected:
    """What support views show at points that are seen along given directions.

    A view has more weight the closer its ray is to the direction, up to 60 degrees, and the closer the point is to the
    surface that the view sees.

    Args:
        planes: of the support views, with CHANNELS channels.
        chosen: the indices of the views that count for each point, as `nearest_views` finds them.
        points: on rays of a new view.
        directions: of these rays, of length 1.
        radius: of the scene.
    """
    size = max(1, PAIR_CHUNK // chosen.shape[1])
    split = zip(chosen.split(size), points.split(size), directions.split(size), strict=True)
    parts = [_reproject(planes, *part, radius) for part in split]
    return Reprojected(*(torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Reprojected)))


def _reproject(planes: ImagePlanes, chosen: Tensor, points: Tensor, directions: Tensor, radius: float) -> Reprojected:
    found = planes.lookup(points, chosen, return_directions=True)
    assert found.directions is not None
    assert found.distances is not None
    residual, moment, opacity, image = found.colours.split([3, 1, 1, 3], -1)
    # outside of an image opacity is 0, so the surface seems to be at the camera, and the weight is 0
    apart = (found.distances - (moment / opacity.clamp_min(1e-3)).squeeze(-1)).abs() / radius
    aside = 1 - (found.directions * directions[:, None]).sum(-1)
    least = math.exp(-ANGULAR_FALLOFF * MAX_COSINE_DISTANCE)
    weights = (torch.exp(-ANGULAR_FALLOFF * aside) - least).clamp_min(0)
    weights = (weights * torch.exp(-(apart / DISTANCE_SCALE).square()))[:, None]
    squares = (each.square().mean(-1, keepdim=True) for each in (residual, image))
    sums = (weights @ torch.cat([residual, image, *squares], -1))[:, 0]
    total = weights.sum(-1)
    means = sums / total.clamp_min(MIN_WEIGHT)
    of_residuals, of_images, *squared = means.split([3, 3, 1, 1], -1)
    variances = [
        (square - mean.square().mean(-1, keepdim=True)).clamp_min(0)
        for square, mean in zip(squared, (of_residuals, of_images), strict=True)
    ]
    added = sums[:, :3] / (total + DOUBT)
    return Reprojected(added, of_images, total, *variances)


def nearest_views(
    planes: ImagePlanes,
    points: Float[Tensor, "point 3"],
    directions: Float[Tensor, "point 3"],
    without: int | None = None,
) -> tuple[Int[Tensor, "point view"], Bool[Tensor, " all_views"]]:
    """The support views that count for points of a new view: the MAX_VIEWS whose rays are closest to its rays.

    Args:
        planes: of the support views.
        points: the farthest point of each ray.
        directions: of the rays, of length 1.
        without: index of a view that does not count; there must be another one.

    Returns:
        Indices of the views for each point, and for each view whether it may have a weight above 0 for any of them, or
        of those before them on their rays.
    """
    centres = camera.centres(planes.cameras).to(points)
    count = min(MAX_VIEWS, len(centres) - (without is not None))
    size = max(1, PAIR_CHUNK // len(centres))
    chosen, near = [], torch.zeros(len(centres), dtype=torch.bool, device=points.device)
    for places, along in zip(points.split(size), directions.split(size), strict=True):
        offsets = torch.nn.functional.normalize(places[:, None] - centres, dim=-1)
        cosines = (offsets * along[:, None]).sum(-1)
        if without is not None:
            cosines[:, without] = -torch.inf
        cosines, views = cosines.topk(count, 1)
        near[views[1 - cosines < MAX_COSINE_DISTANCE]] = True
        chosen.append(views)
    return torch.cat(chosen), near
