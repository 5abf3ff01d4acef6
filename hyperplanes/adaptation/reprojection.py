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

__all__ = ["CHANNELS", "Reprojected", "are_near", "reproject"]

CHANNELS = 8  # of a support view: residual, depth times opacity, opacity, image
ANGULAR_FALLOFF = 10.0  # of weights as a function of 1 - the cosine of the angle between rays: a third at 27 degrees
MAX_COSINE_DISTANCE = 0.5  # value of 1 - cosine from which on the weight is 0: 60 degrees
DISTANCE_SCALE = 0.25  # distance from the surface that a support view sees, in radii, at which the weight is 1 / e
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
    chosen: Int[Tensor, " view"],
    points: Float[Tensor, "point 3"],
    directions: Float[Tensor, "point 3"],
    radius: float,
) -> Reprojected:
    """What support views show at points that are seen along given directions.

    A view has more weight the closer its ray is to the direction, up to 60 degrees, and the closer the point is to the
    surface that the view sees.

    Args:
        planes: of the support views, with CHANNELS channels.
        chosen: indices of the views that count; at least one.
        points: on rays of a new view.
        directions: of these rays, of length 1.
        radius: of the scene.
    """
    size = max(1, PAIR_CHUNK // len(chosen))
    parts = [
        _reproject(planes, chosen, *part, radius)
        for part in zip(points.split(size), directions.split(size), strict=True)
    ]
    return Reprojected(*(torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Reprojected)))


def _reproject(planes: ImagePlanes, chosen: Tensor, points: Tensor, directions: Tensor, radius: float) -> Reprojected:
    found = planes.lookup(points, chosen.expand(len(points), -1), return_directions=True)
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


def are_near(
    planes: ImagePlanes, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
) -> Bool[Tensor, " view"]:
    """The support views that may have a weight above 0 for any of the points, or of those before them on their rays.

    Args:
        planes: of the support views.
        points: as for `reproject`.
        directions: as for `reproject`.
    """
    centres = camera.centres(planes.cameras).to(points)
    near = torch.zeros(len(centres), dtype=torch.bool, device=points.device)
    size = max(1, PAIR_CHUNK // len(centres))
    for places, along in zip(points.split(size), directions.split(size), strict=True):
        offsets = torch.nn.functional.normalize(places[:, None] - centres, dim=-1)
        near |= (1 - (offsets * along[:, None]).sum(-1) < MAX_COSINE_DISTANCE).any(0)
    return near
