"""ImagePlanes that also say which views see a point, by image borders, masks and the depth of the visual hull."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.chosen_views import (
    INVISIBLE_PENALTY,
    PENALTY_RADIANS,
    SMALLEST_ANGLE,
    WEIGHT_FALLOFF,
    ChosenViews,
    Described,
    Penalties,
    Reading,
    Visibility,
)
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.inputs import Selection
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.visibility.first_hits import first_hits
from hyperplanes.geometry.visibility.penalties import ViewPenalties, margins
from hyperplanes.utilities.tensors.cached_on import cached_on
from hyperplanes.utilities.tensors.transforms import (
    are_plain,
    is_transformed,
    outside_transforms,
    wants_values_alone,
    without_derivatives,
)

__all__ = ["VisibilityPlanes", "choose_torch"]

VISIBILITY_CHUNK = 512  # per kernel call
SAME_CENTRE = 1e-3  # distance in radii up to which views are from the same place


class VisibilityPlanes:
    """ImagePlanes with the masks and the depth of the visual hull beside the colours.

    A view's penalty at a point is how far the point lies behind the first surface that it sees, in radii of the scene
    beyond the `tolerance` and at most MAX_DEPTH_PENALTY; PARTIAL_MASK_PENALTY more where its mask is not opaque, so
    that background is mixed into the colour; and INVISIBLE_PENALTY where the point is not in the picture. Where a
    border of a picture crops the object, the penalty rises over a BORDER_MARGIN towards it, so that the view has no
    weight left where the picture ends: otherwise seams would show between pictures of different exposure
    (Buehler et al. 2001, "Unstructured Lumigraph Rendering").

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
        self._maps = _Maps(
            torch.ones_like(images[:, 0]) if masks is None else masks[:, 0].to(images), cameras, occupancy
        )
        self._surface: Float[Tensor, "view height width 2"] | None = None
        self._view_penalties = ViewPenalties(
            images.new_zeros(len(images)),
            images.new_zeros(len(images), 4) if masks is None else margins(masks).to(images),
            Penalties(),
        )

    def __len__(self) -> int:
        return len(self.colours)

    @property
    def depth_opacity(self) -> Float[Tensor, "view height width 2"]:
        """Distance of the first occupied voxel along the ray of each pixel (`first_hits`), and opacity."""
        return self._maps.complete

    @property
    def maps(self) -> Float[Tensor, "view height width 2"]:
        """As `depth_opacity`, for callers that read opacities alone: the depths may not have been computed yet."""
        return self._maps.values

    @property
    def tolerance(self) -> float:
        """The side of a voxel in radii of the scene. With up to 128 voxels an axis, depths are exact to it."""
        return 2 / self.occupancy.occupied.shape[0]

    def mask_views(self, views: Selection) -> VisibilityPlanes:
        """The same planes with more views masked: no point is valid in them, and their colour is the background.

        Args:
            views: indices of the views to mask, or a boolean for each view.
        """
        result = copy.copy(self)
        result.colours = self.colours.mask_views(views)
        return result

    def with_penalties(self, penalties: Penalties) -> VisibilityPlanes:
        """The same planes with other penalties of the views.

        Args:
            penalties: the costs of depth and of masks.
        """
        return self._with(penalties=penalties)

    def with_penalty_offsets(self, offsets: Float[Tensor, " view"]) -> VisibilityPlanes:
        """The same planes with penalty offsets of the views.

        Args:
            offsets: added to the penalty of each view wherever it shows a point.
        """
        return self._with(offsets=offsets.to(self._view_penalties.offsets))

    def with_penalty_at(self, centre: Float[Tensor, 3], penalty: float) -> VisibilityPlanes:
        """The same planes with a penalty added to the offsets of views from one place.

        Args:
            centre: of their cameras, up to SAME_CENTRE.
            penalty: 1 is worth PENALTY_RADIANS radians of angle.
        """
        offsets = self._view_penalties.offsets
        apart = (camera.centres(self.colours.cameras).to(offsets) - centre.to(offsets)).norm(dim=1)
        return self._with(offsets=offsets + penalty * (apart < SAME_CENTRE * self.occupancy.bounds.radius))

    def _with(self, **changes: Any) -> VisibilityPlanes:
        """The same planes with other view penalties."""
        result = copy.copy(self)
        result._view_penalties = replace(self._view_penalties, **changes)
        return result

    def with_surface(self, voxels: Occupancy) -> VisibilityPlanes:
        """The same planes, whose views nearest to a direction are chosen by another surface than the hull's.

        Args:
            voxels: within the hull; a pixel whose ray meets none of them sees every point along it.
        """
        result = copy.copy(self)
        opacity = self.maps[..., 1]
        distances = first_hits(voxels, self.colours.cameras, opacity[:, None])
        result._surface = torch.stack([distances.to(opacity), opacity], -1)
        return result

    @without_derivatives()
    def choose(
        self,
        points: Float[Tensor, "point 3"],
        directions: Float[Tensor, "point 3"] | None = None,
        *,
        best: int,
        nearest: int = 0,
    ) -> Visibility:
        """The views that see each point best, and those nearest to a direction; without gradients.

        Args:
            points: in the world.
            directions: unit vectors along which the points are seen; without them there are no nearest views.
            best: number of views of least penalty, at most all; 0 where only the nearest are wanted.
            nearest: number of views with the least sum of their angle to the direction, in radians, and
                PENALTY_RADIANS times their penalty where it is positive. One more is returned where there is one.

        Returns:
            The views, chosen from all of them; their colours are not looked up.
        """
        best, nearest = min(best, len(self)), min(nearest + 1, len(self)) if directions is not None else 0
        choose = self._choose_compiled if self.has_kernels(points) else partial(choose_torch, self)
        if not best and not nearest:  # no view is returned, and depths do not count
            return choose(points, directions, 0, 0, self.maps)
        if self._surface is None or directions is None:
            return choose(points, directions, best, nearest, self.depth_opacity)
        near = choose(points, directions, 0, nearest, self._surface)
        return replace(choose(points, None, best, 0, self.depth_opacity), nearest=near.nearest) if best else near

    def has_kernels(self, points: Tensor) -> bool:
        """Whether the kernels take these points: single precision, on the CPU, pinhole cameras, no transform."""
        return self._takes_kernels(points) and are_plain(points)

    def _takes_kernels(self, points: Tensor) -> bool:
        maps = self._maps.values
        kind = points.dtype == torch.float32 == maps.dtype and points.device.type == "cpu" and maps.numel() < 2**31
        return kind and bool(find_spec("numba")) and not isinstance(self.colours.cameras, DistortedCamera)

    def _limits(self) -> list[float]:
        """The parameters of the kernels."""
        own = [self.colours.nearest, 1 / self.occupancy.bounds.radius, self.tolerance]
        return [*own, *self._view_penalties.limits(self.maps.shape[1:3])]

    def shown_cameras(self) -> Tensor:
        """What the kernels read of each view: centre, projection matrix, 0 where masked, penalty offset and margins."""
        penalties, masked, cameras = self._view_penalties, self.colours.masked, self.colours.cameras
        poses = cached_on(self, "poses", [cameras.extrinsics, cameras.intrinsics], self._poses)
        shown = poses.new_ones(len(self)) if masked is None else (~masked).to(poses)
        return torch.cat([poses, torch.stack([shown, penalties.offsets]), penalties.margins.T])

    def _poses(self) -> Float[Tensor, "number view"]:
        """Centres and projection matrices."""
        cameras = self.colours.cameras
        found = torch.cat([camera.centres(cameras), camera.projection_matrices(cameras).flatten(1)], 1)
        return found.T.to(self.maps)

    def _choose_compiled(
        self, points: Tensor, directions: Tensor | None, best: int, nearest: int, depth_opacity: Tensor
    ) -> Visibility:
        """As `choose`, by the compiled kernel."""
        count = len(points)
        views = torch.empty(count, best, dtype=torch.long), torch.empty(count, nearest, dtype=torch.long)
        values = torch.empty(count, best, 6), torch.empty(count, nearest, 6)
        overall = torch.empty(count, 2)
        along = points[:0] if directions is None else directions
        fixed = [each.contiguous().flatten().numpy() for each in (points, along, self.shown_cameras(), depth_opacity)]
        shape = (*depth_opacity.shape[:3], best, nearest, len(self))
        numbers = np.array(self._limits(), np.float32)
        outputs = [each.flatten().numpy() for each in (views[0], values[0], views[1], values[1], overall)]
        kernel = compile_kernel("visibility.choosing.choose", torch.float32)
        parallel_for(lambda a, b: kernel(*fixed, shape, numbers, *outputs, a, b), count, VISIBILITY_CHUNK)
        chosen = [ChosenViews(each, *_split(value)) for each, value in zip(views, values, strict=True)]
        return Visibility(chosen[0], None if directions is None else chosen[1], *overall.unbind(1))

    def can_describe(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"] | None = None
    ) -> bool:
        """Whether `describe` takes these points: those that the kernels take, where no derivative is wanted.

        Args:
            points: in the world.
            directions: along which the points are seen, if any.
        """
        if type(self) is not VisibilityPlanes or not self._takes_kernels(points):
            return False
        given = [points, self.colours.cameras.intrinsics, self.colours.cameras.extrinsics]
        if not wants_values_alone(*given, *([] if directions is None else [directions])):
            return False
        return self.colours.packed_images(points) is not None

    @torch.no_grad()
    def describe(
        self,
        points: Float[Tensor, "point 3"],
        directions: Float[Tensor, "point 3"] | None,
        reading: Reading,
        bounds: Sphere,
        grid: Float[Tensor, "channel x y z"] | None = None,
    ) -> Described:
        """What a network reads of points, by one kernel (see `can_describe`); without gradients.

        Args:
            points: in the world.
            directions: unit vectors along which the points are seen; without them nothing is blended.
            reading: how many views, and how they are encoded.
            bounds: the sphere that the network sees as the unit sphere.
            grid: features over the scene, appended to the rows, the first one through a sigmoid; copied unless the
                features of a cell are adjacent in memory.
        """
        count, views = len(points), self.maps.shape[:3]
        packed = self.colours.packed_images(points)
        assert packed is not None
        features = points.new_zeros(1, 1, 1, 0) if grid is None else grid.permute(1, 2, 3, 0).contiguous()
        rows = torch.empty(count, reading.row_size + features.shape[3]) if reading.best else torch.empty(count, 0)
        coverage = torch.empty(count if reading.best else 0)
        along = points[:0] if directions is None else directions
        near = torch.empty(count, 0 if directions is None else reading.near_size)
        kept = min(reading.nearest, len(self))
        weights, colours = torch.empty(len(along), kept), torch.empty(len(along), kept, 3)
        surface = points.new_zeros(0) if self._surface is None else self._surface
        depths = self.depth_opacity if reading.best or self._surface is None else self.maps
        numbers = [*self._limits(), WEIGHT_FALLOFF, reading.falloff, SMALLEST_ANGLE]
        frequencies = reading.point_frequencies, reading.direction_frequencies
        maps = [each.contiguous().flatten().numpy() for each in (self.shown_cameras(), depths, surface)]
        fixed = (
            points.contiguous().numpy(), along.contiguous().numpy(), *maps,
            packed.words.flatten().numpy().view(np.uint32), features.numpy(),
            (*views, reading.best, reading.nearest, len(self), packed.bits, *frequencies),
            np.array(numbers, np.float32), np.array([*bounds.centre, 1 / bounds.radius], np.float32),
            *(each.numpy() for each in (rows, coverage, near, weights, colours)),
        )  # fmt: skip
        kernel = compile_kernel("visibility.describing.describe", torch.float32)
        parallel_for(lambda a, b: kernel(*fixed, a, b), count, VISIBILITY_CHUNK)
        return Described(rows, coverage, near, weights, colours)


def choose_torch(
    planes: VisibilityPlanes, points: Tensor, directions: Tensor | None, best: int, nearest: int, depth_opacity: Tensor
) -> Visibility:
    """`VisibilityPlanes.choose` in plain PyTorch, for given depths and opacities.

    Args:
        planes: the views.
        points: in the world.
        directions: along which the points are seen, or None.
        best: as in `choose`.
        nearest: number of views nearest to the direction.
        depth_opacity: depth and opacity of each pixel.
    """
    # depth and opacity of every view where the point falls: (point, view)
    maps = planes.colours.with_images(depth_opacity.permute(0, 3, 1, 2))
    found = maps.lookup(points, return_directions=True)
    rays, distances = found.directions, found.distances
    assert rays is not None
    assert distances is not None
    valid = found.valid if planes.colours.masked is None else found.valid & ~planes.colours.masked
    depth, coverage = found.colours.unbind(-1)
    coverage = torch.where(valid, coverage, 1.0)
    # depth behind the surface, in radii, and the penalty of each view
    behind = torch.where(valid, (distances - depth) / planes.occupancy.bounds.radius, 0.0)
    penalty = planes._view_penalties.penalty(
        behind - planes.tolerance, coverage, found.coordinates, depth_opacity.shape[1:3]
    )
    penalty = torch.where(valid, penalty, INVISIBLE_PENALTY)

    def chosen(score: Tensor, count: int) -> ChosenViews:
        if not count:
            score = score[:, :0]  # nothing to sort
        index = score.sort(stable=True, dim=1).indices[:, :count]
        along = rays.gather(1, index[..., None].expand(-1, -1, 3))
        return ChosenViews(index, along, *(each.gather(1, index) for each in (behind, coverage, penalty)))

    near = None
    if directions is not None:
        angle = torch.acos((rays * directions[:, None]).sum(-1).clamp(-1, 1))
        near = chosen(angle + PENALTY_RADIANS * penalty.clamp_min(0), nearest)
    return Visibility(chosen(penalty, best), near, coverage.amin(1), valid.sum(1).to(points))


class _Maps:
    """Depth and opacity of each pixel, shared by planes and all their copies.

    Args:
        opacity: opacity of the masks.
        cameras: of the views.
        occupancy: grid whose first voxel along a ray gives the depth.
    """

    def __init__(
        self, opacity: Float[Tensor, "view height width"], cameras: PinholeCamera, occupancy: Occupancy
    ) -> None:
        self._cameras, self._occupancy = cameras, occupancy
        self._values = torch.stack([torch.ones_like(opacity), opacity], -1)
        self._complete = False

    @property
    def values(self) -> Float[Tensor, "view height width 2"]:
        """The depths, which are 1 until they are asked for, and the opacities."""
        return self._values

    @property
    def opacity(self) -> Float[Tensor, "view height width"]:
        """Opacity of the masks."""
        return self._values[..., 1]

    @property
    def complete(self) -> Float[Tensor, "view height width 2"]:
        """The values with their depths, which are computed once: cameras and occupancy must not change after that.

        They are constants under function transforms, but computed anew where a transform made the tensors.
        """
        if self._complete:
            return self._values
        given = (self._values, self._occupancy.occupied, self._cameras.extrinsics, self._cameras.intrinsics)
        if is_transformed(*given):
            return self._computed()
        with outside_transforms():
            self._values, self._complete = self._computed(), True
        return self._values

    def _computed(self) -> Float[Tensor, "view height width 2"]:
        depth = first_hits(self._occupancy, self._cameras, self.opacity[:, None])
        return torch.stack([depth, self.opacity], -1)


def _split(values: Float[Tensor, "point chosen 6"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Directions, depths, coverages and penalties."""
    return values[..., :3], values[..., 3], values[..., 4], values[..., 5]
