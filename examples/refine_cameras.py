"""Find wrong cameras again by gradient descent on the pictures, through the renderer.

A scene of coloured blobs, known exactly, is rendered from cameras around it. Then every camera is turned by up to 10
degrees and moved by up to 5 % of its distance, and all of them are found again from the pictures alone: the error
between what a camera should see and what the renderer says it sees has a gradient with respect to the camera.

    python examples/refine_cameras.py --plot refined.png
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry import cast
from hyperplanes.geometry.rays import pixel_grid
from hyperplanes.rendering.renderer import Hierarchical, render

SAMPLING = Hierarchical(coarse=20, fine=0)


@dataclass(frozen=True)
class Blobs:
    """A field: Gaussian clouds, each of one colour."""

    centres: Tensor
    widths: Tensor
    colours: Tensor

    @classmethod
    def make(cls, count: int = 9, seed: int = 0) -> Blobs:
        """Blobs of random places, sizes and colours within 0.65 of the origin."""
        generator = torch.Generator().manual_seed(seed)
        where = torch.randn(count, 3, generator=generator)
        where *= 0.65 * torch.rand(count, 1, generator=generator).sqrt() / where.norm(dim=-1, keepdim=True)
        return cls(
            where, 0.1 + 0.12 * torch.rand(count, generator=generator), torch.rand(count, 3, generator=generator)
        )

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Colour and density at points; directions do not matter."""
        square = points.square().sum(-1, keepdim=True) - 2 * points @ self.centres.T + self.centres.square().sum(-1)
        near = torch.exp(-square / (2 * self.widths**2))
        colour = near @ self.colours / near.sum(-1, keepdim=True).clamp_min(1e-9)
        return colour, 12 * near.sum(-1)


def render_pixels(scene: Blobs, cameras: PinholeCamera) -> Tensor:
    """The pixels (view, pixel, 3) of the cameras, with gradients to these."""
    height, width = camera.image_size(cameras)
    views = cameras.batch_size
    pixels = pixel_grid(height, width).repeat(views, 1)
    view = torch.arange(views).repeat_interleave(height * width)
    return render(scene, cast(cameras, view, pixels), SAMPLING).colour.reshape(views, height * width, 3)


def turned(pose: Tensor, change: Tensor) -> Tensor:
    """camera_from_world after turning the world about its origin, then shifting it, as the camera sees both.

    Args:
        pose: (view, 4, 4).
        change: (view, 6), a rotation vector in radians and a shift in world units. Turning about the scene instead of
            about the camera keeps the two apart: a shift moves the picture, a turn shows another side.
    """
    x, y, z = change[:, :3].unbind(-1)
    zero = torch.zeros_like(x)
    rotation = torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3))
    upper = torch.cat([rotation @ pose[:, :3, :3], pose[:, :3, 3:] + change[:, 3:, None]], 2)
    return torch.cat([upper, pose[:, 3:]], 1)


def perturbed(pose: Tensor, degrees: float, fraction: float, seed: int) -> Tensor:
    """Cameras turned about themselves by half of `degrees` to all of it, and moved likewise by a part of the distance.

    Args:
        pose: (view, 4, 4) camera_from_world.
        degrees: the largest turn.
        fraction: the largest move, of the distance to the origin.
        seed: of the random directions.
    """
    generator = torch.Generator().manual_seed(seed)
    axis, way = torch.nn.functional.normalize(torch.randn(2, len(pose), 3, generator=generator), dim=-1)
    amount, length = 0.5 + 0.5 * torch.rand(2, len(pose), 1, generator=generator)
    rotation = turned(
        torch.eye(4).repeat(len(pose), 1, 1), torch.cat([axis * amount * math.radians(degrees), 0 * way], 1)
    )
    world_from_camera = torch.linalg.inv(pose)
    distance = world_from_camera[:, :3, 3].norm(dim=-1, keepdim=True)
    world_from_camera[:, :3, 3] += way * length * fraction * distance
    return rotation @ torch.linalg.inv(world_from_camera)


def errors(found: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Degrees between the cameras' rotations, and the distance between their centres, in % of that to the origin."""
    chord = (found - true)[:, :3, :3].flatten(1).norm(dim=-1) / math.sqrt(8)  # sin of half the angle between
    centres = [torch.linalg.inv(pose)[:, :3, 3] for pose in (found, true)]
    apart = (centres[0] - centres[1]).norm(dim=-1) / centres[1].norm(dim=-1)
    return torch.rad2deg(2 * torch.asin(chord.clamp(max=1))), 100 * apart


@dataclass
class Refined:
    """What the refinement found, and how it went there.

    Attributes:
        pose: (view, 4, 4).
        degrees: largest error of all cameras after each step.
        percent: likewise, of the distance.
    """

    pose: Tensor
    degrees: list[float] = field(default_factory=list)
    percent: list[float] = field(default_factory=list)


def refine(scene: Blobs, pose: Tensor, true: Tensor, size: int, steps: int) -> Refined:
    """Descends on the squared difference of the pictures, first small ones, then ones of full size.

    Args:
        scene: the field.
        pose: the cameras to start from.
        true: the cameras that took the pictures; used for the pictures and for reporting errors.
        size: pixels a side at the end.
        steps: of Adam.
    """
    change = torch.zeros(len(pose), 6, requires_grad=True)
    optimiser = torch.optim.Adam([change], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, 2e-4)
    result = Refined(pose)
    shown = 0
    for step in range(steps):
        now = size // 2 if step < 3 * steps // 4 else size
        intrinsics = camera.symmetric_intrinsics(now, now, math.radians(50))
        if now != shown:
            with torch.no_grad():
                pictures = render_pixels(scene, camera.pinhole(intrinsics, true, now, now))
            shown = now
        seen = render_pixels(scene, camera.pinhole(intrinsics, turned(pose, change), now, now))
        loss = (seen - pictures).square().mean((1, 2)).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        result.pose = turned(pose, change.detach())
        degrees, percent = errors(result.pose, true)
        result.degrees.append(float(degrees.max()))
        result.percent.append(float(percent.max()))
    return result


def plot(scene: Blobs, true: Tensor, start: Tensor, result: Refined, path: Path) -> None:
    """Pictures before, after and as they should be, above the errors over the steps.

    Args:
        scene: the field.
        true: the cameras that took the pictures.
        start: the cameras before.
        result: the cameras after.
        path: where the plot goes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.5), layout="constrained")
    grid = figure.add_gridspec(4, 4)
    intrinsics = camera.symmetric_intrinsics(96, 96, math.radians(50))
    rows = {"start": start, "found": result.pose, "truth": true}
    for row, (name, pose) in enumerate(rows.items()):
        with torch.no_grad():
            pictures = render_pixels(scene, camera.pinhole(intrinsics, pose[:4], 96, 96)).reshape(-1, 96, 96, 3)
        for column, picture in enumerate(pictures):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(picture.clamp(0, 1).numpy())
            axes.set(xticks=[], yticks=[], ylabel=name if column == 0 else "")
    curves = figure.add_subplot(grid[3, :])
    curves.semilogy(result.degrees, label="rotation: degrees, worst camera")
    curves.semilogy(result.percent, label="centre: % of the distance, worst camera")
    curves.axhline(0.5, color="C0", ls=":", lw=1)
    curves.axhline(1.0, color="C1", ls=":", lw=1)
    curves.set_xlabel("step")
    curves.legend(fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    """Perturb, refine, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--size", type=int, default=40, help="pixels a side")
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--degrees", type=float, default=10.0)
    parser.add_argument("--fraction", type=float, default=0.05, help="of the distance to the scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path, metavar="FILE")
    options = parser.parse_args()
    scene, true = Blobs.make(), camera.fibonacci_sphere(options.views, 2.7, -0.5, 0.8)
    start = perturbed(true, options.degrees, options.fraction, options.seed)
    result = refine(scene, start, true, options.size, options.steps)
    before, after = errors(start, true), errors(result.pose, true)
    print("camera  degrees before  after   % of the distance before  after")
    for view in range(options.views):
        print(
            f"{view:6d}  {before[0][view]:14.2f}  {after[0][view]:5.3f}  {before[1][view]:25.2f}  {after[1][view]:5.3f}"
        )
    if options.plot:
        plot(scene, true, start, result, options.plot)
        print(f"plot: {options.plot}")


if __name__ == "__main__":
    main()
