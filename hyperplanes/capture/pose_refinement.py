"""Refinement of poses from the images, before a field is adapted to them.

A grid of density and colour is optimised together with a small motion of each camera, on rays of all views, from small
images and few cells to larger ones, so that poses are first fitted to coarse shapes (Lin et al. 2021, "BARF"). The grid
is then discarded. Fields of this package would hide errors of poses, since they look colours up in the views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, softplus

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Rays, Sphere
from hyperplanes.geometry.volume import interpolate_grid, resampled_grid
from hyperplanes.rendering.compositing import composite
from hyperplanes.utilities.tensors.gradients import with_gradients
from hyperplanes.utilities.tensors.precision import without_autocast
from hyperplanes.utilities.tensors.uncompiled_optimisers import Adam
from hyperplanes.views import Views

__all__ = ["FEWEST_VIEWS", "Refined", "refine_poses"]

LEVELS = ((32, 32, 200), (64, 48, 200), (128, 64, 200))
"""Pixels along the longer side of the pictures, cells of the grid along an axis, and steps."""

FEWEST_VIEWS = 5
RAYS_PER_STEP = 2048
GRID_RATE, POSE_RATE = 0.2, 5e-3  # of Adam
FIXED = 40  # steps before the cameras move: the first grid is too large and would misplace them
FINAL_RATE = 0.1  # fraction of the rate of the poses at the last step
SAMPLES_PER_CELL = 1.5  # along a ray, per cell of the grid along an axis
INITIAL_OUTSIDE, INITIAL_INSIDE = -6.0, 0.0  # initial values of the grid, before softplus: optical depth of a cell
INITIAL_WITHOUT_MASKS = -3.0  # the same without masks
MIN_OPTICAL_DEPTH = 0.02  # optical depth up to which cells are skipped, if they are more than two cells from others
VOTES = 0.2  # fraction of the masks that must exclude a cell to carve it, as some poses are wrong
MASK_MARGIN = 0.08  # distance from the masks within which rays are drawn, as a fraction of the longer side of an image

Grid = Float[Tensor, "channel x y z"]


@dataclass(frozen=True)
class Refined:
    """Views with refined cameras.

    Attributes:
        views: the same images.
        turned: degrees by which each camera was rotated about the centre of the bounds.
    """

    views: Views
    turned: Float[Tensor, " view"]


class _MovedCameras(nn.Module):
    """Cameras with rigid motions about the centre of the bounds.

    There a rotation and a translation change an image differently; about the camera's own centre, a rotation is nearly
    a translation. Focal lengths are fixed: one that was wrong by 3 % changed by 0.2 %, and the cameras moved instead.
    """

    def __init__(self, cameras: PinholeCamera, bounds: Sphere) -> None:
        super().__init__()
        self.cameras, self.bounds = cameras, bounds
        self.twist = nn.Parameter(torch.zeros(cameras.batch_size, 6))  # radians about x, y, z, shift in radii

    def relative(self) -> Float[Tensor, "view 6"]:
        """The motions minus their mean, so that the world does not move."""
        return self.twist - self.twist.mean(0)

    def forward(self) -> PinholeCamera:
        twist = self.relative()
        x, y, z = twist[:, :3].unbind(1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
        upper = torch.cat([cross, twist[:, 3:, None] * self.bounds.radius], 2)
        motion = torch.linalg.matrix_exp(torch.cat([upper, torch.zeros_like(upper[:, :1])], 1))
        middle, back = torch.eye(4), torch.eye(4)
        middle[:3, 3] = torch.tensor(self.bounds.centre)
        back[:3, 3] = -middle[:3, 3]
        pose = camera.camera_from_world(self.cameras) @ middle @ motion @ back
        return camera.with_poses(self.cameras, pose)


@without_autocast
@with_gradients
def refine_poses(views: Views, *, on_step: Callable[[int, int], None] | None = None) -> Refined:
    """Views whose cameras fit the images better, if they did not fit well.

    Poses that are off by some degrees are corrected to a fraction of a pixel (docs/adaptation.md). Poses that are right
    to a tenth of a pixel become worse: compare both on held-out views.

    Args:
        views: of one object, with or without masks, without lens distortion.
        on_step: called with the number of steps done and the total.

    Returns:
        The views on the CPU in single precision; the mean motion of the cameras is zero. Raises RuntimeError inside
        `torch.inference_mode`.

    Raises:
        ValueError: fewer than five views, or cameras with lens distortion.
    """
    if len(views) < FEWEST_VIEWS or isinstance(views.cameras, DistortedCamera):
        found = f"{len(views)}" + (" with lens distortion" if isinstance(views.cameras, DistortedCamera) else "")
        raise ValueError(
            f"views: expected at least {FEWEST_VIEWS} without lens distortion to refine poses, got {found}"
        )
    views = views.to("cpu", torch.float32)
    generator = torch.Generator().manual_seed(0)
    cameras = _MovedCameras(views.cameras, views.bounds)
    motion = Adam([cameras.twist], betas=(0.9, 0.99))
    grid, done, total = _first_grid(views, LEVELS[0][1]), 0, sum(steps for _, _, steps in LEVELS)
    for pixels, side, steps in LEVELS:
        # the same object with larger images and smaller cells
        small = views.resized(pixels)
        among = _near_masks(small)
        grid = resampled_grid(grid.detach(), side)
        occupancy = Occupancy(softplus(grid[0]) > MIN_OPTICAL_DEPTH, views.bounds).dilated(2)
        grid = grid.clone().requires_grad_(True)
        content = Adam([grid], lr=GRID_RATE, betas=(0.9, 0.99))
        for _ in range(steps):
            # rays of the current cameras, and the error of the grid
            shown = replace(small, cameras=camera.resized(cameras(), *small.size))
            rays, truth, opacity = shown.sample_masked_rays(RAYS_PER_STEP, generator=generator, among=among)
            loss = _loss(grid, occupancy, rays, truth, None if views.masks is None else opacity[:, 0], generator)
            for optimiser in (content, motion):
                optimiser.zero_grad()
            loss.backward()
            content.step()
            motion.param_groups[0]["lr"] = POSE_RATE * FINAL_RATE ** (done / total) if done >= FIXED else 0.0
            motion.step()
            done += 1
            if on_step is not None:
                on_step(done, total)
    with torch.no_grad():
        turned = torch.rad2deg(cameras.relative()[:, :3].norm(dim=1))
        return Refined(replace(views, cameras=cameras()), turned)


def _loss(
    grid: Grid,
    occupancy: Occupancy,
    rays: Rays,
    truth: Float[Tensor, "ray 3"],
    opacity: Float[Tensor, " ray"] | None,
    generator: torch.Generator,
) -> Tensor:
    """Squared error of the colours of rays, and of their opacity if there are masks."""
    hit: Bool[Tensor, " ray"] = rays.far > rays.near
    near, length = rays.near[hit][:, None], (rays.far - rays.near)[hit][:, None]
    # one sample in each interval of a ray, (ray, sample), and which of them lie in non-empty cells
    count = int(SAMPLES_PER_CELL * grid.shape[1])
    edges = torch.linspace(0, 1, count + 1)
    where = near + length * (edges[:-1] + torch.rand(len(near), count, generator=generator) / count)
    points = rays.origins[hit][:, None] + where[..., None] * rays.directions[hit][:, None]
    inside = occupancy.contains(points.detach())
    # their density and colour; all others are empty
    values = interpolate_grid(grid, points[inside], occupancy.bounds)
    density = torch.zeros(inside.shape).index_put(inside.nonzero().unbind(1), softplus(values[:, 0]) / occupancy.voxel)
    colour = torch.zeros(points.shape).index_put(inside.nonzero().unbind(1), torch.sigmoid(values[:, 1:]))
    seen, _ = composite(colour, density, near + length * edges)
    loss = (seen.colour - truth[hit]).square().mean()
    return loss if opacity is None else loss + (seen.opacity - opacity[hit]).square().mean()


def _near_masks(views: Views) -> Int[Tensor, " pixel"] | None:
    """Flat indices (view, row, column) of the pixels in the masks and around them; None without masks."""
    if views.masks is None:
        return None
    reach = max(1, round(MASK_MARGIN * max(views.size)))
    return max_pool2d(views.masks, 2 * reach + 1, 1, reach).flatten().nonzero()[:, 0]


def _first_grid(views: Views, side: int) -> Grid:
    """A grey visual hull, from which a cell is carved by several masks, or thin fog without masks."""
    grid = torch.zeros(4, side, side, side)
    grid[0] = INITIAL_WITHOUT_MASKS
    if views.masks is not None:
        small = views.resized(64)
        assert small.masks is not None
        hull = carve(small.masks, small.cameras, views.bounds, side, votes=max(1, round(VOTES * len(views))))
        grid[0] = torch.where(hull.occupied, INITIAL_INSIDE, INITIAL_OUTSIDE)
    return grid
