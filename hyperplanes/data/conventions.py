"""Do the poses mean what the file says? Masks decide: only with the right poses do the silhouettes agree."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from hyperplanes.axes import flip_camera_axes
from hyperplanes.data.bounds import estimate_bounds
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views

__all__ = ["AS_DECLARED", "Conventions", "check_conventions"]

AS_DECLARED = "as declared"
SIDE = 32
MASK = 64
MOST_VIEWS = 16
CLEARLY = 0.15


@dataclass(frozen=True)
class Conventions:
    """How well the silhouettes agree under each reading of the poses.

    Attributes:
        scores: mean overlap (intersection over union, 0 to 1) of the masks with the silhouettes of their own visual
            hull, by reading; empty where there are no masks to compare.
        best: the reading under which they agree best; "as declared" unless another one is clearly better.
    """

    scores: dict[str, float]
    best: str

    @property
    def consistent(self) -> bool:
        """Whether no other reading explains the masks clearly better."""
        return self.best == AS_DECLARED

    def line(self) -> str:
        """One line for people."""
        if not self.scores:
            return "conventions: not checked, the images have no masks"
        declared = self.scores[AS_DECLARED]
        if self.consistent:
            others = max(score for name, score in self.scores.items() if name != AS_DECLARED)
            return (
                f"conventions: masks agree with the poses (coarse hull's overlap {declared:.0%}; under other readings "
                f"of the poses {others:.0%} at best)"
            )
        return (
            f"conventions: WRONG, the masks agree with the poses as declared by {declared:.0%} only, but by "
            f"{self.scores[self.best]:.0%} if the poses are {self.best}; convert them, or correct the declaration"
        )


@torch.no_grad()
def check_conventions(views: Views) -> Conventions:
    """Try the ways in which poses are commonly mistaken for others.

    Args:
        views: of one scene; without masks nothing can be said.

    Returns:
        The overlap under each reading of the poses.
    """
    if views.masks is None or len(views) < 3 or not 0 < float((views.masks > 0).float().mean()) < 0.95:
        return Conventions({}, AS_DECLARED)
    chosen = torch.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().long()
    masks, cameras = _small(views.masks[chosen], camera.select(views.cameras, chosen))
    scores = {name: _overlap(masks, cameras, pose) for name, pose in _readings(cameras).items()}
    best = max(scores, key=lambda name: scores[name])
    return Conventions(scores, best if scores[best] > scores[AS_DECLARED] + CLEARLY else AS_DECLARED)


def _readings(cameras: PinholeCamera) -> dict[str, Tensor]:
    """camera_from_world under each suspicion about the file, which the reader took for OpenGL camera-to-world."""
    declared = camera.camera_from_world(cameras)
    written = camera.opengl_from_opencv(declared)  # as it stands in a transforms.json
    return {
        AS_DECLARED: declared,
        "in OpenCV axes (y down, z forward), not OpenGL's": _flip_rows(declared),
        "camera-from-world in OpenGL axes, not its inverse": _flip_rows(written),
        "camera-from-world in OpenCV axes, not OpenGL camera-to-world": written,
    }


def _flip_rows(camera_from_world: Tensor) -> Tensor:
    return flip_camera_axes(camera_from_world.mT).mT


def _overlap(masks: Tensor, cameras: PinholeCamera, pose: Tensor) -> float:
    candidate = camera.with_poses(cameras, pose)
    sphere = estimate_bounds(candidate)
    ahead = camera.camera_from_world(candidate)[:, 2] @ pose.new_tensor([*sphere.centre, 1.0])
    if (ahead > 0).float().mean() < 0.5:
        return 0.0  # most cameras look away from where all would meet
    for _ in range(2):  # the second time around what the first has found
        hull = carve(masks, candidate, sphere, SIDE)
        points = hull.centres()
        points = points[sphere.normalise(points).norm(dim=-1) <= 1]
        if not len(points):
            return 0.0
        middle = (points.amin(0) + points.amax(0)) / 2
        radius = float((points - middle).norm(dim=-1).max()) + hull.voxel
        sphere = Sphere(tuple(middle.tolist()), min(radius, sphere.radius))
    seen = _silhouettes(points, hull, candidate)
    wanted = masks[:, 0] > 0
    union = (seen | wanted).flatten(1).sum(1)
    return float(((seen & wanted).flatten(1).sum(1) / union.clamp_min(1)).mean())


def _silhouettes(
    points: Float[Tensor, "voxel 3"], hull: Occupancy, cameras: PinholeCamera
) -> Bool[Tensor, "view height width"]:
    """Which pixels see a voxel: its centre's pixel, and those around it as far as half the voxel reaches."""
    height, width = camera.image_size(cameras)
    matrices = camera.projection_matrices(cameras)
    seen = torch.zeros(len(matrices), height, width, dtype=torch.bool)
    for view, matrix in enumerate(matrices):
        homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
        front = homogeneous[homogeneous[:, 2] > hull.voxel]
        column, row = (front[:, :2] / front[:, 2:]).round().long().unbind(-1)
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        if not inside.any():
            continue
        picture = torch.zeros(1, height, width)
        picture[0, row[inside], column[inside]] = 1.0
        focal = float(camera.intrinsics(cameras)[view, 0, 0])
        reach = int(focal * hull.voxel / 2 / float(front[:, 2].median()))
        seen[view] = max_pool2d(picture, 2 * reach + 1, 1, reach)[0] > 0
    return seen


def _small(masks: Tensor, cameras: PinholeCamera) -> tuple[Tensor, PinholeCamera]:
    height, width = masks.shape[2:]
    factor = MASK / max(height, width)
    if factor >= 1:
        return masks, cameras
    size = max(1, round(height * factor)), max(1, round(width * factor))
    return (interpolate(masks, size, mode="area") > 0.2).float(), camera.resized(cameras, *size)
