"""ImagePlanes that also say which of them see a point: by their borders, masks and the depth of the visual hull."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.inputs import Numbers
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import cast

__all__ = ["Visibility", "VisibilityPlanes", "first_hits"]

STEPS = 128  # along a diameter of the scene, where rays look for their first occupied voxel
ROUND = 8  # of them at once


@dataclass(frozen=True)
class Visibility:
    """How the planes see points.

    Attributes:
        directions: unit vectors from each camera's centre to the point, in the world.
        behind: how far the point lies behind the first surface of the hull along the ray of each camera, in radii of
            the scene; negative before it.
        coverage: opacity of the mask where the point falls.
        valid: the point falls into the image, and the view is not hidden.
    """

    directions: Float[Tensor, "point view 3"]
    behind: Float[Tensor, "point view"]
    coverage: Float[Tensor, "point view"]
    valid: Bool[Tensor, "point view"]


class VisibilityPlanes:
    """ImagePlanes with the masks and the depth of the visual hull beside the colours.

    Args:
        images: (view, 3, height, width), RGB in [0, 1].
        cameras: one an image.
        masks: (view, 1, height, width), opacity in [0, 1]; None counts as opaque everywhere.
        occupancy: the visual hull, or any grid that holds the object.
    """

    def __init__(
        self,
        images: Float[Tensor, "view 3 height width"],
        cameras: PinholeCamera,
        masks: Float[Tensor, "view 1 height width"] | None,
        occupancy: Occupancy,
    ) -> None:
        self.colours = ImagePlanes(images, cameras)
        self.occupancy = occupancy
        depth = first_hits(occupancy, cameras, masks).to(images)
        opacity = torch.ones_like(images[:, :1]) if masks is None else masks.to(images)
        self.guides = ImagePlanes(torch.cat([depth[:, None], opacity], 1), cameras, exact=True)
        self._hidden: Bool[Tensor, " view"] | None = None

    def __len__(self) -> int:
        return len(self.colours)

    @property
    def tolerance(self) -> float:
        """The side of a voxel in radii of the scene: what depths are exact to."""
        return 2 / self.occupancy.occupied.shape[0]

    def hiding(self, views: Int[Tensor, " hidden"]) -> VisibilityPlanes:
        """The same planes, of which some see nothing.

        Args:
            views: their indices.
        """
        result = copy.copy(self)
        result._hidden = torch.zeros(len(self), dtype=torch.bool, device=views.device).index_fill_(0, views, True)
        return result

    def visibility(self, points: Float[Tensor, "point 3"]) -> Visibility:
        """How each plane sees each point; not differentiable in the points.

        Args:
            points: in the world.
        """
        found = self.guides.lookup(points, return_directions=True)
        assert found.directions is not None
        assert found.distances is not None
        depth, coverage = found.colours.unbind(-1)
        valid = found.valid if self._hidden is None else found.valid & ~self._hidden
        return Visibility(found.directions, (found.distances - depth) / self.occupancy.bounds.radius, coverage, valid)


@torch.no_grad()
def first_hits(
    occupancy: Occupancy, cameras: PinholeCamera, masks: Numbers | None = None
) -> Float[Tensor, "view height width"]:
    """The distance from each camera to the first occupied voxel along the ray of each pixel.

    Args:
        occupancy: the grid.
        cameras: of one image size.
        masks: (view, 1, height, width); where they are 0 nothing is looked for.

    Returns:
        Distances along unit rays, to half a STEPS-th of the scene's diameter; where there is nothing, that of the far
        end of the ray in the scene's sphere, or of the sphere's centre plus its radius.
    """
    height, width = camera.image_size(cameras)
    device = cameras.extrinsics.device
    centre = torch.tensor(occupancy.bounds.centre, device=device)
    far = (camera.centres(cameras) - centre).norm(dim=1) + occupancy.bounds.radius
    result = far[:, None, None].repeat(1, height, width)
    shown = torch.ones(len(result), height, width, dtype=torch.bool, device=device)
    if masks is not None:
        shown = torch.as_tensor(masks, device=device)[:, 0] > 0
    view, row, column = shown.nonzero().unbind(1)
    rays = cast(cameras, view, torch.stack([column, row], -1).to(result), occupancy.bounds)
    step = 2 * occupancy.bounds.radius / STEPS
    nearest, left = rays.far.clone(), torch.arange(len(rays), device=device)
    for first in range(0, STEPS + 1, ROUND):
        part = rays[left]
        t = part.near[:, None] + (torch.arange(first, first + ROUND, device=device) + 0.5) * step
        inside = occupancy.contains(part.at(t)) & (t < part.far[:, None])
        hit = inside.any(1)
        nearest[left[hit]] = t[hit].gather(1, inside[hit].byte().argmax(1, keepdim=True))[:, 0]
        left = left[~hit & (t[:, -1] < part.far)]
        if not len(left):
            break
    result[view, row, column] = nearest
    return result
