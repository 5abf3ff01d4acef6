"""Baking of an adapted field into a sparse voxel grid that renders in real time: `hyperplanes bake`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures
from hyperplanes.fields.baked import HARMONICS, LARGEST_SIDE, BakedField, spherical_harmonics
from hyperplanes.fields.base import MLPField
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.kernels.threads import parallel_map
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.images import join_pictures, render_images
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.rendering.scene import SplitField
from hyperplanes.rendering.transmittance import transmittance
from hyperplanes.rendering.voxels import STOP_TRANSMITTANCE, VoxelGrid, render_voxels, shade_voxels
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["BakedScene", "bake", "coarsening", "default_side"]

BAKING_CHUNK = 1 << 12
COLOUR_DIRECTIONS = 12  # from which colour is evaluated; at least one a harmonic
TRANSMITTANCE_SIDE = 128  # voxels an axis of the grid of transmittances
MIN_TRANSMITTANCE = 0.02  # voxels that no viewing direction reaches with more than this are left out
MIN_VOXEL_OPACITY = 0.005  # over 1/128 of the scene's diameter; voxels below it are left out
# as in `render_images`; voxels are cheap enough for extra rays in more pixels, which bring 0.1 dB
BAKED_EDGE_THRESHOLD = 0.5
MIN_WEIGHT = 0.01  # of a voxel in the pixel that sees it best; voxels below it are left out


@dataclass(frozen=True)
class BakedScene:
    """A baked field that renders new views.

    Attributes:
        field: the voxels.
        steps: samples along a diameter of the scene's sphere.
    """

    field: BakedField
    steps: int = 192

    @checked
    @torch.no_grad()
    def render(self, cameras: PinholeCamera) -> Pictures:
        """The pictures of cameras on any device, by a kernel if the voxels are on the CPU, else by `RayMarching`."""
        bounds, cameras = self.field.bounds, camera.to(cameras, self.field.index.device)
        if self.field.index.device.type != "cpu":
            return self.adapted.render(cameras, self.adapted.sampling)
        step = 2 * bounds.radius / self.steps

        def view(place: int) -> Pictures:
            one = camera.select(cameras, [place])
            shaded = shade_voxels(self.field.values, self._centres, camera.centres(one)[0])

            def render_rays(rays: Rays) -> Rendered:
                return render_voxels(self.grid, shaded, rays, step=step)

            return render_images(
                one, bounds, render_rays, occupancy=self._coarse_occupancy, antialias=True, edge=BAKED_EDGE_THRESHOLD
            )

        return join_pictures([view(place) for place in range(cameras.batch_size)])

    @cached_property
    def adapted(self) -> AdaptedField:
        """The voxels as an `AdaptedField`."""
        return AdaptedField(self.field, self.field.occupancy, RayMarching(self.steps, STOP_TRANSMITTANCE))

    @cached_property
    def grid(self) -> VoxelGrid:
        """The voxels prepared for ray casting."""
        return VoxelGrid.of(self.field.index, self.field.bounds)

    @cached_property
    def _centres(self) -> Float[Tensor, "row 3"]:
        """The centre of each row's voxel."""
        return self.field.centres()

    def footprint(self, cameras: PinholeCamera) -> Bool[Tensor, "view height width"]:
        """The pixels whose rays may meet a voxel."""
        return footprint(self._coarse_occupancy, cameras)

    @cached_property
    def _coarse_occupancy(self) -> Occupancy:
        """The occupancy in few large voxels, whose footprint is cheap enough to save time."""
        return _resampled(self.field.occupancy, max(8, self.field.side // 4))


@checked
@torch.no_grad()
def bake(adapted: AdaptedField, *, side: int = 256, on_part: Callable[[int, int], None] | None = None) -> BakedField:
    """Density and view-dependent colour of a field, at the voxels that are visible from outside.

    Colour is fitted by least squares over a sphere of viewing directions, each weighted by the transmittance from
    outside to the voxel along it, so that directions from which the voxel is hidden do not count.

    Args:
        adapted: the field of one object.
        side: voxels an axis; two for each pixel of the object's width lose little quality.
        on_part: called with the numbers of voxels done and in total.

    Returns:
        The voxels, on the CPU.

    Raises:
        ValueError: a field that is empty everywhere.
    """
    coarser = coarsening(side)
    view = camera.fibonacci_sphere(COLOUR_DIRECTIONS, 1.0)[:, 2, :3].to(adapted.occupancy.occupied.device)
    # transmittance from outside to coarse voxels, along every direction
    coarse = _in_sphere(_resampled(adapted.refined_occupancy, side // coarser))
    optical_depth = torch.zeros_like(coarse.occupied, dtype=view.dtype)
    density = torch.cat([adapted.density(part) for part in coarse.centres().split(BAKING_CHUNK)])
    optical_depth[coarse.occupied] = density * coarse.voxel
    arriving = transmittance(optical_depth, coarse.occupied.nonzero(), view)
    # voxels that are visible from some direction
    visible = torch.zeros_like(coarse.occupied)
    visible[coarse.occupied] = arriving.amax(1) > MIN_TRANSMITTANCE
    row = torch.zeros(coarse.occupied.numel(), dtype=torch.long, device=view.device)
    row[coarse.occupied.flatten()] = torch.arange(len(arriving), device=view.device)
    # density and coefficients of the fine voxels in visible ones
    fine = _in_sphere(_resampled(Occupancy(visible, coarse.bounds), side))

    def voxels(points: Tensor) -> tuple[Tensor, Tensor]:
        some, found = _voxels(adapted, points, view, arriving[row[coarse.index(points)]], fine.voxel)
        return fine.index(points)[some], found

    cells, rows, centres = [], [], fine.centres()
    parallel = adapted.thread_safe and centres.device.type == "cpu"
    for cell, found in (parallel_map if parallel else map)(voxels, centres.split(BAKING_CHUNK)):
        cells.append(cell)
        rows.append(found)
        if on_part:
            on_part(min(len(cells) * BAKING_CHUNK, len(centres)), len(centres))
    if not sum(len(part) for part in cells):
        raise ValueError("bake: expected a field with something in it, got one that is empty everywhere")
    filled, values = torch.cat(cells), torch.cat(rows)
    # the row of each voxel
    index = torch.full((side**3,), -1, dtype=torch.int32, device=view.device)
    index[filled] = torch.arange(len(filled), dtype=torch.int32, device=view.device)
    return BakedField(index.reshape(side, side, side).cpu(), values.cpu(), fine.bounds)


def coarsening(side: int) -> int:
    """Number of voxels along an axis that share one transmittance, for a field of `side` voxels an axis.

    Args:
        side: voxels an axis.

    Raises:
        ValueError: too few, too many, or not a multiple of that number.
    """
    coarser = max(2, side // TRANSMITTANCE_SIDE)
    if side % coarser or not 8 <= side <= LARGEST_SIDE:
        raise ValueError(f"side: expected a multiple of {coarser} from 8 to {LARGEST_SIDE}, got {side}")
    return coarser


def default_side(size: tuple[int, int]) -> int:
    """Voxels an axis that suit fitting to views of (height, width): 1.4 per pixel, at most 256.

    More voxels are not constrained between the rays of the views' pixels. Fitted to 25 views of 64x64, new views of a
    car, a chair and a lamp have 33.0, 31.3 and 34.5 dB with 128 voxels an axis, 32.9, 31.9 and 34.7 with 96, and 31.5,
    31.6 and 32.2 with 64.

    >>> default_side((64, 64)), default_side((100, 80)), default_side((400, 400))
    (96, 128, 256)
    """
    return min(256, max(64, 32 * round(1.4 * max(size) / 32)))


def _voxels(
    adapted: AdaptedField, points: Tensor, view: Tensor, arriving: Tensor, voxel: float
) -> tuple[Bool[Tensor, " point"], Float[Tensor, "filled 28"]]:
    """Which points have density, and the density and coefficients of these."""
    field = adapted.field if adapted.dtype == points.dtype else adapted
    length = adapted.occupancy.bounds.radius / 64
    hidden = field.hidden(points) if isinstance(field, SplitField) else points
    density = field.density_of(hidden) if isinstance(field, SplitField) else adapted.density(points)
    some = 1 - torch.exp(-density * length) > MIN_VOXEL_OPACITY
    some &= arriving.amax(1) * (1 - torch.exp(-density * voxel)) > MIN_WEIGHT
    hidden, density, arriving = hidden[some], density[some], arriving[some]
    if isinstance(field, MLPField):
        colours = field.colours_along(hidden, view)
    else:
        colour = field.colour_of if isinstance(field, SplitField) else lambda *seen: field(*seen)[0]
        colours = torch.stack([colour(hidden, each.expand(len(density), 3)) for each in view], 1)
    return some, torch.cat([density[:, None], _harmonics(colours, view, arriving)], 1)


def _resampled(occupancy: Occupancy, side: int) -> Occupancy:
    """The same region at another resolution: all voxels that it touches."""
    grid = torch.nn.functional.adaptive_max_pool3d(occupancy.occupied[None, None].float(), side)
    return Occupancy(grid[0, 0] > 0, occupancy.bounds)


def _in_sphere(occupancy: Occupancy) -> Occupancy:
    """The voxels that samples on rays, which end at the sphere, can interpolate from."""
    side = occupancy.occupied.shape[0]
    along = ((torch.arange(side, device=occupancy.occupied.device) + 0.5) * (2 / side) - 1).square()
    away = along[:, None, None] + along[:, None] + along
    return Occupancy(occupancy.occupied & (away.sqrt() <= 1 + 2 / side), occupancy.bounds)


def _harmonics(
    colours: Float[Tensor, "point direction 3"], view: Float[Tensor, "direction 3"], arriving: Tensor
) -> Float[Tensor, "point 27"]:
    """Colour coefficients, red first, by weighted least squares with a small ridge penalty on all but the mean."""
    basis = spherical_harmonics(view)
    weights = (arriving + 1e-3)[..., None]
    ridge = torch.full((HARMONICS,), 1e-2 * len(view), device=view.device)
    ridge[0] = 1e-6
    normal = basis.T @ (weights * basis) + torch.diag(ridge) * arriving.mean(1)[:, None, None].clamp_min(1e-3)
    right = basis.T @ (weights * colours)
    return torch.linalg.solve(normal, right).mT.flatten(1)
