"""ImagePlanes that also say which of them see a point: by their borders, masks and the depth of the visual hull."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.first_hits import first_hits
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.kernels.compiling import compile_kernel
from hyperplanes.geometry.kernels.threads import parallel_for
from hyperplanes.geometry.lookup_torch import transform_of
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays, Sphere

__all__ = [
    "ANGLE",
    "UNSEEN",
    "ChosenViews",
    "Penalties",
    "Described",
    "Reading",
    "Visibility",
    "VisibilityPlanes",
]

POINTS = 512  # that one call of the kernel works on
RAYS = 512  # likewise

DEEPEST = 2.0  # radii
PARTLY = 2.0  # penalty of a mask that is not whole
WHOLE = 0.98  # opacity of a mask from which on it counts as whole
UNSEEN = 8.0  # penalty of a view that does not show the point
FADING = 10.0  # of the weights of views, with their penalty
ANGLE = 10.0  # radians of angle that a penalty of 1 counts for
SMALLEST_ANGLE = 1e-2  # between a view and a direction, in radians: nearer ones count as that far


@dataclass(frozen=True)
class Penalties:
    """What counts against a view that does not see a point well; ANGLE radians of angle each.

    Attributes:
        deepest: the most that a point behind the first surface costs.
        partly: what a mask costs that is not whole.
        steep: cost of a radius behind the surface.
        highest: of both together.
    """

    deepest: float = DEEPEST
    partly: float = PARTLY
    steep: float = 1.0
    highest: float = DEEPEST + PARTLY

    @classmethod
    def alike(cls) -> Penalties:
        """A view sees a point or does not: whatever hides it costs 1."""
        return cls(deepest=1e3, partly=1e6, steep=1e6, highest=1.0)


@dataclass(frozen=True)
class ChosenViews:
    """Some views of each point, best first.

    Attributes:
        views: their indices.
        directions: unit vectors from each camera's centre to the point, in the world.
        behind: how far the point lies behind the first surface of the hull along the ray of each camera, in radii of
            the scene; negative before it.
        coverage: opacity of the mask where the point falls.
        penalty: how badly the view sees the point; UNSEEN where it does not show it at all.
    """

    views: Int[Tensor, "point chosen"]
    directions: Float[Tensor, "point chosen 3"]
    behind: Float[Tensor, "point chosen"]
    coverage: Float[Tensor, "point chosen"]
    penalty: Float[Tensor, "point chosen"]

    @property
    def valid(self) -> Bool[Tensor, "point chosen"]:
        """Whether each view shows the point: it falls into the image, and the view is not hidden."""
        return self.penalty < UNSEEN

    @property
    def weights(self) -> Float[Tensor, "point chosen"]:
        """Weights that fall with the penalty and sum to one; all zero where no view shows the point."""
        weights = torch.exp(-FADING * self.penalty.clamp_min(0)) * self.valid
        return weights / weights.sum(1, keepdim=True).clamp_min(1e-6)

    def first(self, count: int) -> ChosenViews:
        """The first of the views.

        Args:
            count: how many; all where there are fewer.
        """
        return ChosenViews(*(getattr(self, each.name)[:, :count] for each in fields(self)))

    def angles(self, directions: Float[Tensor, "point 3"]) -> Float[Tensor, "point chosen"]:
        """Between a direction at each point and the ray of each view, in radians."""
        return torch.acos((self.directions * directions[:, None]).sum(-1).clamp(-1 + 1e-6, 1 - 1e-6))

    def lumigraph_weights(self, angles: Float[Tensor, "point chosen"], count: int) -> Float[Tensor, "point blended"]:
        """Weights of the first views in a blend of their colours; not normalised.

        A view at angle a has the weight 1 / a - 1 / a_max, a_max being the angle of the next view, so that the blend
        changes continuously with the direction (Buehler et al. 2001, "Unstructured Lumigraph Rendering"). A view that
        does not see the point counts as one at a greater angle.

        Args:
            angles: of `angles`.
            count: how many views are blended.
        """
        score = (angles + ANGLE * self.penalty.clamp_min(0)).clamp_min(SMALLEST_ANGLE)
        farthest = score[:, count : count + 1] if score.shape[1] > count else 2 * score[:, -1:]
        return (1 / score[:, :count] - 1 / (1.01 * farthest)).clamp_min(1e-6)


@dataclass(frozen=True)
class Visibility:
    """How the planes see points.

    Attributes:
        best: the views that see each point best.
        nearest: those of similar viewing direction, which see it, one more than was asked for where there are so many.
        coverage: the least opacity over the views that show the point; 1 where none does.
        number: of the views that show the point.
    """

    best: ChosenViews
    nearest: ChosenViews | None
    coverage: Float[Tensor, " point"]
    number: Float[Tensor, " point"]


@dataclass(frozen=True)
class Reading:
    """How a network reads views.

    Attributes:
        best: views of the least penalty; 0 reads none of them.
        nearest: views nearest to a direction.
        point_frequencies: of the encoded point.
        direction_frequencies: of the encoded direction.
        falloff: of depths behind the hull, in 1 / radii, where tanh makes them inputs.
    """

    best: int
    nearest: int
    point_frequencies: int
    direction_frequencies: int
    falloff: float

    @property
    def row_size(self) -> int:
        """The encoded point, nine numbers of each of the best views, eleven of all of them."""
        return 3 + 6 * self.point_frequencies + 9 * self.best + 11

    @property
    def near_size(self) -> int:
        """The encoded direction, and seven numbers of each of the nearest views."""
        return 3 + 6 * self.direction_frequencies + 7 * self.nearest


@dataclass(frozen=True)
class Described:
    """What a network reads of points, in rows.

    Attributes:
        rows: the encoded point; colour in [-1, 1], depth behind the hull, coverage, validity and direction of each of
            the best views; mean, variance and difference to the best of their colours, least coverage, logarithm of the
            number of views; features of a grid.
        coverage: the least opacity over the views that show the point.
        near_rows: the encoded direction; colour, angle, depth, coverage and validity of each of the nearest views.
        near_weights: logarithms of the weights of the blend (`fields.image_based`).
        near_colours: in [0, 1], white where a view does not show the point.
    """

    rows: Float[Tensor, "point number"]
    coverage: Float[Tensor, " covered"]
    near_rows: Float[Tensor, "point near_number"]
    near_weights: Float[Tensor, "seen near"]
    near_colours: Float[Tensor, "seen near 3"]


class VisibilityPlanes:
    """ImagePlanes with the masks and the depth of the visual hull beside the colours.

    A view's penalty at a point is how far the point lies behind the first surface that it sees, in radii of the scene
    beyond the `tolerance` and at most DEEPEST; PARTLY more where its mask is not whole, so that background is mixed
    into the colour; and UNSEEN where the point is not in the picture.

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
        self.depth_opacity: Float[Tensor, "view height width 2"] = images.new_ones(*images[:, 0].shape, 2)
        self.depth_opacity[..., 0] = first_hits(occupancy, cameras, masks)
        if masks is not None:
            self.depth_opacity[..., 1] = masks[:, 0]
        matrices, centres = camera.projection_matrices(cameras).flatten(1), camera.centres(cameras)
        self._surface: Float[Tensor, "view height width 2"] | None = None
        self._cameras: Float[Tensor, "number view"] = torch.cat([centres, matrices], 1).T.to(images)
        self._masked = torch.zeros(len(images), dtype=torch.bool, device=images.device)
        self._penalties = Penalties()

    def __len__(self) -> int:
        return len(self.colours)

    @property
    def tolerance(self) -> float:
        """The side of a voxel in radii of the scene: what depths are exact to."""
        return 2 / self.occupancy.occupied.shape[0]

    def mask_views(self, views: Int[Tensor, " masked"]) -> VisibilityPlanes:
        """The same planes, some more of which see nothing: no point is valid there, and its colour is the background.

        Args:
            views: their indices.
        """
        result = copy.copy(self)
        result.colours = self.colours.mask_views(views)
        result._masked = self._masked.index_fill(0, views.to(self._masked.device), True)
        return result

    def with_penalties(self, penalties: Penalties) -> VisibilityPlanes:
        """The same planes with other penalties of the views.

        Args:
            penalties: what counts against a view, and how much.
        """
        result = copy.copy(self)
        result._penalties = penalties
        return result

    def with_surface(self, voxels: Occupancy) -> VisibilityPlanes:
        """The same planes, of which those nearest to a direction are judged by another surface than the hull's.

        Args:
            voxels: within the hull; a pixel whose ray meets none of them sees all that lies along it.
        """
        result = copy.copy(self)
        mask = self.depth_opacity[..., 1]
        distances = first_hits(voxels, self.colours.cameras, mask[:, None])
        result._surface = torch.stack([distances.to(mask), mask], -1)
        return result

    @torch.no_grad()
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
            best: how many views of the least penalty, at most all.
            nearest: how many views of the least sum of the angle between the direction and theirs, in radians, and
                ANGLE times their penalty, where that is positive. One more is returned, where there is one.

        Returns:
            The views. All of them are looked at; colours are looked up by who wants them.
        """
        best, nearest = min(best, len(self)), min(nearest + 1, len(self)) if directions is not None else 0
        choose = self._choose_compiled if self.has_kernels(points) else self._choose_torch
        if self._surface is None or directions is None:
            return choose(points, directions, best, nearest, self.depth_opacity)
        near = choose(points, directions, 1, nearest, self._surface).nearest
        return replace(choose(points, None, best, 0, self.depth_opacity), nearest=near)

    def has_kernels(self, points: Tensor) -> bool:
        """Whether the kernels take these points: single precision, on the CPU, pinhole cameras."""
        pinholes = not isinstance(self.colours.cameras, DistortedCamera)
        compiled = find_spec("numba") and points.device.type == "cpu" and self.depth_opacity.numel() < 2**31
        return bool(compiled) and points.dtype == torch.float32 == self.depth_opacity.dtype and pinholes

    def _limits(self) -> list[float]:
        """The numbers by which the kernels judge."""
        per_radius, own = 1 / self.occupancy.bounds.radius, self._penalties
        limits = [self.colours.nearest, per_radius, self.tolerance, own.deepest, own.partly, WHOLE, UNSEEN, ANGLE]
        return [*limits, own.steep, own.highest]

    def _shown_cameras(self) -> Tensor:
        """What the kernels read of each view: centre, projection matrix, and 0 where it is hidden."""
        return torch.cat([self._cameras, (~self._masked).to(self._cameras)[None]])

    def _choose_compiled(
        self, points: Tensor, directions: Tensor | None, best: int, nearest: int, depth_opacity: Tensor
    ) -> Visibility:
        """As `choose`, by the compiled kernel."""
        count = len(points)
        views = torch.empty(count, best, dtype=torch.long), torch.empty(count, nearest, dtype=torch.long)
        values = torch.empty(count, best, 6), torch.empty(count, nearest, 6)
        overall = torch.empty(count, 2)
        along = points[:0] if directions is None else directions
        fixed = [each.contiguous().flatten().numpy() for each in (points, along, self._shown_cameras(), depth_opacity)]
        shape = (*depth_opacity.shape[:3], best, nearest, len(self))
        numbers = np.array(self._limits(), np.float32)
        outputs = [each.flatten().numpy() for each in (views[0], values[0], views[1], values[1], overall)]
        kernel = compile_kernel("visibility.choose", torch.float32)
        parallel_for(lambda a, b: kernel(*fixed, shape, numbers, *outputs, a, b), count, POINTS)
        chosen = [ChosenViews(each, *_split(value)) for each, value in zip(views, values, strict=True)]
        return Visibility(chosen[0], None if directions is None else chosen[1], *overall.unbind(1))

    @torch.no_grad()
    def hull_hits(
        self, rays: Rays, first: Float[Tensor, " ray"], step: float, voxels: Occupancy, opacity: float
    ) -> Float[Tensor, " ray"]:
        """The first samples of rays in the visual hull, by one kernel; `has_kernels` says of which points.

        Args:
            rays: with far.
            first: distance of the first sample of each.
            step: from one sample to the next.
            voxels: a sample lies in the hull only where these are occupied.
            opacity: that every view which shows a sample has there at least.

        Returns:
            Their distances along the rays; infinite where there is none.
        """
        cameras, bounds = self._shown_cameras(), voxels.bounds
        arrays = [each.contiguous().numpy() for each in (rays.origins, rays.directions, first, rays.far)]
        fixed = (
            *arrays, np.float32(step), np.array([*bounds.centre, bounds.radius], np.float32),
            voxels.occupied.contiguous().numpy().view(np.uint8),
            *(each.contiguous().flatten().numpy() for each in (cameras, self.depth_opacity)),
            (*self.depth_opacity.shape[:3], cameras.shape[1]),
            np.array([self.colours.nearest, opacity], np.float32),
        )  # fmt: skip
        nearest = torch.empty(len(rays))
        kernel = compile_kernel("hull_hits.hull_hits", torch.float32)
        parallel_for(lambda a, b: kernel(*fixed, nearest.numpy(), a, b), len(rays), RAYS)
        return nearest

    def blended(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"], nearest: int
    ) -> Float[Tensor, "point 3"]:
        """The mean of the colours of the views nearest to a direction that see the point (`lumigraph_weights`).

        Args:
            points: in the world.
            directions: unit vectors along which the points are seen.
            nearest: how many views, at most all.
        """
        if self.can_describe(points):
            near = self.describe(points, directions, Reading(0, nearest, 0, 0, 0.0), self.occupancy.bounds)
            weights, colours = near.near_weights.softmax(1), near.near_colours
        else:
            seen = self.choose(points, directions, best=1, nearest=nearest).nearest
            assert seen is not None
            weights = seen.lumigraph_weights(seen.angles(directions), min(nearest, len(self)))
            weights = weights / weights.sum(1, keepdim=True)
            colours = self.colours.lookup(points).colours
            colours = colours.gather(1, seen.first(nearest).views[..., None].expand(-1, -1, 3))
        return (weights[..., None] * colours).sum(1)

    def can_describe(self, points: Float[Tensor, "point 3"]) -> bool:
        """Whether `describe` takes these points: those that the kernels take, where no gradient goes through them."""
        given = (points, *(getattr(self.colours.cameras, name) for name in ("intrinsics", "extrinsics")))
        if type(self) is not VisibilityPlanes or torch.compiler.is_compiling() or transform_of(points):
            return False
        if torch.is_grad_enabled() and any(each.requires_grad for each in given):
            return False
        if not self.has_kernels(points) or self.colours.background != 1.0:
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
        """What a network reads of points, by one kernel; `can_describe` says where. Without gradients.

        Args:
            points: in the world.
            directions: unit vectors along which the points are seen; without them nothing is blended.
            reading: how many views, and how they are encoded.
            bounds: the sphere that the network sees as the unit sphere.
            grid: features over the scene, which are written into the same rows, the first through a sigmoid; in any
                layout, without a copy where the numbers of a cell are side by side.
        """
        count, views = len(points), self.depth_opacity.shape[:3]
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
        numbers = [*self._limits(), FADING, reading.falloff, SMALLEST_ANGLE]
        frequencies = reading.point_frequencies, reading.direction_frequencies
        maps = [each.contiguous().flatten().numpy() for each in (self._shown_cameras(), self.depth_opacity, surface)]
        fixed = (
            points.contiguous().numpy(), along.contiguous().numpy(), *maps,
            packed.words.flatten().numpy().view(np.uint32), features.numpy(),
            (*views, reading.best, reading.nearest, len(self), packed.bits, *frequencies),
            np.array(numbers, np.float32), np.array([*bounds.centre, 1 / bounds.radius], np.float32),
            *(each.numpy() for each in (rows, coverage, near, weights, colours)),
        )  # fmt: skip
        kernel = compile_kernel("described.describe", torch.float32)
        parallel_for(lambda a, b: kernel(*fixed, a, b), count, POINTS)
        return Described(rows, coverage, near, weights, colours)

    def _choose_torch(
        self, points: Tensor, directions: Tensor | None, best: int, nearest: int, depth_opacity: Tensor
    ) -> Visibility:
        """As `choose`, in plain PyTorch."""
        # depth and opacity of every view where the point falls: (point, view)
        planes = ImagePlanes(depth_opacity.permute(0, 3, 1, 2), self.colours.cameras, exact=True)
        found = planes.lookup(points, return_directions=True)
        assert found.directions is not None
        assert found.distances is not None
        valid = found.valid & ~self._masked
        depth, coverage = found.colours.unbind(-1)
        coverage = torch.where(valid, coverage, 1.0)
        # how far behind the surface, in radii, and what that and a broken mask cost
        behind = torch.where(valid, (found.distances - depth) / self.occupancy.bounds.radius, 0.0)
        own = self._penalties
        penalty = (own.steep * (behind - self.tolerance)).clamp(-own.deepest, own.deepest)
        penalty = (penalty + own.partly * (coverage < WHOLE)).clamp_max(own.highest)
        penalty = torch.where(valid, penalty, UNSEEN)
        values = torch.cat([found.directions, torch.stack([behind, coverage, penalty], -1)], -1)

        def chosen(score: Tensor, count: int) -> ChosenViews:
            index = score.sort(stable=True, dim=1).indices[:, :count]
            return ChosenViews(index, *_split(values.gather(1, index[..., None].expand(-1, -1, 6))))

        near = None
        if directions is not None:
            angle = torch.acos((found.directions * directions[:, None]).sum(-1).clamp(-1, 1))
            near = chosen(angle + ANGLE * penalty.clamp_min(0), nearest)
        return Visibility(chosen(penalty, best), near, coverage.amin(1), valid.sum(1).to(points))


def _split(values: Float[Tensor, "point chosen 6"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Directions, depths, coverages and penalties."""
    return values[..., :3], values[..., 3], values[..., 4], values[..., 5]
