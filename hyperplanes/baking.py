"""From an adapted field to a sparse voxel grid that renders at once: `hyperplanes bake`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures, photograph
from hyperplanes.fields.baked import HARMONICS, LARGEST_SIDE, BakedField, spherical_harmonics
from hyperplanes.fields.base import Field
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.marching import march
from hyperplanes.rendering.renderer import Marched
from hyperplanes.rendering.voxels import cast_through_voxels, compiled_caster

__all__ = ["BakedScene", "bake"]

CHUNK = 1 << 12
FAINT = 0.01  # what adds less than this to a pixel is left out


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
            return AdaptedField(self.field, self.field.occupancy, Marched(self.steps)).render(cameras)
        step = 2 * bounds.radius / self.steps

        def see(rays: Rays) -> Rendered:
            basis = spherical_harmonics(rays.directions)
            return cast_through_voxels(self.field.index, self.field.values, bounds, rays, basis, step=step)

        return photograph(cameras, bounds, see, seen=self.field.occupancy)


@torch.no_grad()
def bake(adapted: AdaptedField, *, side: int = 128, directions: int = 24) -> BakedField:
    """Density and view-dependent colour of a field, at the voxels that can be seen from outside.

    Colour is fitted by least squares over a sphere of viewing directions, each weighted by how much of a ray from
    outside arrives at the voxel along it: what nobody can see does not disturb what everybody does.

    Args:
        adapted: the field of one object.
        side: voxels an axis.
        directions: viewing directions asked of every voxel.

    Returns:
        The voxels, on the CPU.

    Raises:
        ValueError: fewer directions than harmonics, or a field that is empty everywhere.
    """
    if directions < HARMONICS:
        raise ValueError(f"directions: expected at least {HARMONICS}, one a harmonic, got {directions}")
    if side % 2 or not 8 <= side <= LARGEST_SIDE:
        raise ValueError(f"side: expected an even number from 8 to {LARGEST_SIDE}, got {side}")
    view = camera.fibonacci_sphere(directions, 1.0)[:, 2, :3].to(adapted.occupancy.occupied.device)
    coarse = _resampled(adapted.filled, side // 2)
    arriving = _visibility(coarse, _density_at(adapted, coarse.centres()), view)
    visible = torch.zeros_like(coarse.occupied)
    visible[coarse.occupied] = arriving.amax(1) > FAINT
    fine = Occupancy(_resampled(Occupancy(visible, coarse.bounds), side).occupied, coarse.bounds)
    points = fine.centres()
    density = _density_at(adapted, points)
    some = 1 - torch.exp(-density * fine.voxel) > FAINT
    if not some.any():
        raise ValueError("bake: expected a field with something in it, got one that is empty everywhere")
    points, density = points[some], density[some]
    row = torch.zeros(coarse.occupied.numel(), dtype=torch.long, device=points.device)
    row[coarse.occupied.flatten()] = torch.arange(len(arriving), device=points.device)
    arriving = arriving[row[coarse.index(points)]]
    harmonics = [
        _harmonics(adapted, points[part], view, arriving[part])
        for part in torch.arange(len(points), device=points.device).split(CHUNK)
    ]
    index = torch.full((side**3,), -1, dtype=torch.int32, device=points.device)
    index[fine.index(points)] = torch.arange(len(points), dtype=torch.int32, device=points.device)
    values = torch.cat([density[:, None], torch.cat(harmonics)], 1)
    return BakedField(index.reshape(side, side, side).cpu(), values.cpu(), fine.bounds)


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


def _visibility(
    occupancy: Occupancy, density: Float[Tensor, " voxel"], view: Float[Tensor, "direction 3"]
) -> Float[Tensor, "voxel direction"]:
    """How much of a ray that travels along each direction arrives at each occupied voxel."""
    grid = torch.zeros(occupancy.occupied.numel(), device=density.device)
    grid[occupancy.occupied.flatten()] = density
    result = []
    for part in occupancy.centres().split(CHUNK):
        count = len(part) * len(view)
        origins = part[:, None].expand(-1, len(view), -1).reshape(-1, 3)
        back = -view[None].expand(len(part), -1, -1).reshape(-1, 3)
        # out of the object, leaving the voxel itself behind first
        near = torch.full((count,), occupancy.voxel, device=part.device)
        rays = Rays(origins, back, near, torch.full_like(near, 2 * occupancy.bounds.radius))
        samples = march(rays, occupancy, occupancy.voxel)
        places = origins[samples.ray] + samples.middles[:, None] * back[samples.ray]
        thickness = grid[occupancy.index(places)] * occupancy.voxel
        hidden = torch.zeros(count, device=part.device).index_add(0, samples.ray, thickness)
        result.append(torch.exp(-hidden).reshape(len(part), len(view)))
    return torch.cat(result) if result else density.new_zeros(0, len(view))


def _harmonics(
    adapted: AdaptedField, points: Float[Tensor, "point 3"], view: Float[Tensor, "direction 3"], arriving: Tensor
) -> Float[Tensor, "point 27"]:
    """Coefficients of colour, red first, by weighted least squares with a little ridge on all but the mean."""
    count = len(view)
    if isinstance(adapted.field, Field):
        hidden = adapted.field.hidden(points)
        colours = [adapted.field.colour_of(hidden, each.expand(len(points), 3)) for each in view]
    else:
        colours = [adapted.field(points, each.expand(len(points), 3))[0] for each in view]
    basis = spherical_harmonics(view)
    weights = (arriving + 1e-3)[..., None]
    ridge = torch.full((HARMONICS,), 1e-2 * count, device=points.device)
    ridge[0] = 1e-6
    normal = basis.T @ (weights * basis) + torch.diag(ridge) * arriving.mean(1)[:, None, None].clamp_min(1e-3)
    right = basis.T @ (weights * torch.stack(colours, 1))
    return torch.linalg.solve(normal, right).mT.reshape(len(points), -1)
