"""From an adapted field to a sparse voxel grid that renders at once: `hyperplanes bake`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, UInt8
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures, photograph
from hyperplanes.fields.baked import HARMONICS, LARGEST_SIDE, BakedField, spherical_harmonics
from hyperplanes.fields.base import Field
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.light import compiled_light, light_arriving
from hyperplanes.rendering.renderer import Marched
from hyperplanes.rendering.voxels import cast_through_voxels, compiled_caster, empty_around

__all__ = ["BakedScene", "bake"]

CHUNK = 1 << 12
LIGHT = 128  # voxels an axis of the grid in which light is followed; half of that where it is not compiled
UNSEEN = 0.02  # where less than this of any light arrives, nobody looks
THIN = 0.005  # what hides less than this of what is behind it, over 1/128 of the scene's diameter, is left out


@dataclass(frozen=True)
class BakedScene:
    """A baked field that can be looked at.

    Attributes:
        field: the voxels.
        steps: samples along a diameter of the scene's sphere.
    """

    field: BakedField
    steps: int = 192

    @torch.no_grad()
    def render(self, cameras: PinholeCamera) -> Pictures:
        """The pictures that the cameras see; compiled on a CPU with numba, packed torch elsewhere."""
        bounds = self.field.bounds
        if compiled_caster() is None or self.field.index.device.type != "cpu":
            sampling = Marched(self.steps, 1e-3)
            return AdaptedField(self.field, self.field.occupancy, sampling).render(cameras, sampling)
        step = 2 * bounds.radius / self.steps

        def see(rays: Rays) -> Rendered:
            basis = spherical_harmonics(rays.directions)
            return cast_through_voxels(
                self.field.index, self.field.values, bounds, rays, basis, step=step, empty=self._empty
            )

        return photograph(cameras, bounds, see, seen=self._outline)

    @cached_property
    def _empty(self) -> UInt8[Tensor, "cell_x cell_y cell_z"]:
        """What rays leap over."""
        return empty_around(self.field.index)

    @cached_property
    def _outline(self) -> Occupancy:
        """Few large voxels that hold all the others: finding the pixels that look there takes less time than rays."""
        return _resampled(self.field.occupancy, max(8, self.field.side // 4))


@torch.no_grad()
def bake(adapted: AdaptedField, *, side: int = 256, directions: int = 24) -> BakedField:
    """Density and view-dependent colour of a field, at the voxels that can be seen from outside.

    Colour is fitted by least squares over a sphere of viewing directions, each weighted by how much of a ray from
    outside arrives at the voxel along it: what nobody can see does not disturb what everybody does.

    Args:
        adapted: the field of one object.
        side: voxels an axis; two for every pixel that the object is wide lose little.
        directions: viewing directions asked of every voxel.

    Returns:
        The voxels, on the CPU.

    Raises:
        ValueError: fewer directions than harmonics, or a field that is empty everywhere.
    """
    if directions < HARMONICS:
        raise ValueError(f"directions: expected at least {HARMONICS}, one a harmonic, got {directions}")
    light = LIGHT if compiled_light() else LIGHT // 2
    coarser = max(2, side // light)
    if side % coarser or not 8 <= side <= LARGEST_SIDE:
        raise ValueError(f"side: expected a multiple of {coarser} from 8 to {LARGEST_SIDE}, got {side}")
    view = camera.fibonacci_sphere(directions, 1.0)[:, 2, :3].to(adapted.occupancy.occupied.device)
    coarse = _resampled(adapted.filled, side // coarser)
    thickness = torch.zeros_like(coarse.occupied, dtype=view.dtype)
    thickness[coarse.occupied] = _density_at(adapted, coarse.centres()) * coarse.voxel
    arriving = light_arriving(thickness, coarse.occupied.nonzero(), view)
    seen = torch.zeros_like(coarse.occupied)
    seen[coarse.occupied] = arriving.amax(1) > UNSEEN
    row = torch.zeros(coarse.occupied.numel(), dtype=torch.long, device=view.device)
    row[coarse.occupied.flatten()] = torch.arange(len(arriving), device=view.device)
    fine = _resampled(Occupancy(seen, coarse.bounds), side)
    kept, values = [], []
    for points in fine.centres().split(CHUNK):
        cell = fine.index(points)
        found = _voxels(adapted, points, view, arriving[row[coarse.index(points)]])
        kept.append(cell[found[0]])
        values.append(found[1])
    if not sum(len(part) for part in kept):
        raise ValueError("bake: expected a field with something in it, got one that is empty everywhere")
    cells, rows = torch.cat(kept), torch.cat(values)
    index = torch.full((side**3,), -1, dtype=torch.int32, device=view.device)
    index[cells] = torch.arange(len(cells), dtype=torch.int32, device=view.device)
    return BakedField(index.reshape(side, side, side).cpu(), rows.cpu(), fine.bounds)


def _voxels(
    adapted: AdaptedField, points: Tensor, view: Tensor, arriving: Tensor
) -> tuple[Bool[Tensor, " point"], Float[Tensor, "kept 28"]]:
    """Which points hide something, and their density and coefficients."""
    field, length = adapted.field, adapted.occupancy.bounds.radius / 64
    hidden = field.hidden(points) if isinstance(field, Field) else points
    density = field.density_of(hidden) if isinstance(field, Field) else adapted.density(points)
    some = 1 - torch.exp(-density * length) > THIN
    hidden, density, arriving = hidden[some], density[some], arriving[some]
    if isinstance(field, Field):
        colours = field.colours_along(hidden, view)
    else:
        colours = torch.stack([field(hidden, each.expand(len(hidden), 3))[0] for each in view], 1)
    return some, torch.cat([density[:, None], _harmonics(colours, view, arriving)], 1)


def _resampled(occupancy: Occupancy, side: int) -> Occupancy:
    """The same region in another resolution; nothing of it is lost where that is coarser."""
    before = occupancy.occupied.shape[0]
    grid = occupancy.occupied[None, None].float()
    if side < before:
        grid = torch.nn.functional.adaptive_max_pool3d(grid, side)
    else:
        grid = torch.nn.functional.interpolate(grid, (side,) * 3)
    return Occupancy(grid[0, 0] > 0, occupancy.bounds)


def _density_at(adapted: AdaptedField, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
    return torch.cat([adapted.density(part) for part in points.split(CHUNK)] or [points.new_zeros(0)])


def _harmonics(
    colours: Float[Tensor, "point direction 3"], view: Float[Tensor, "direction 3"], arriving: Tensor
) -> Float[Tensor, "point 27"]:
    """Coefficients of colour, red first, by weighted least squares with a little ridge on all but the mean."""
    basis = spherical_harmonics(view)
    weights = (arriving + 1e-3)[..., None]
    ridge = torch.full((HARMONICS,), 1e-2 * len(view), device=view.device)
    ridge[0] = 1e-6
    normal = basis.T @ (weights * basis) + torch.diag(ridge) * arriving.mean(1)[:, None, None].clamp_min(1e-3)
    right = basis.T @ (weights * colours)
    return torch.linalg.solve(normal, right).mT.flatten(1)
