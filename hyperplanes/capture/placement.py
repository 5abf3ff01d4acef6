"""Find the position of the object in a capture, and the up direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.data.pictures.bounds import nearest_point, smallest_ball
from hyperplanes.geometry.rays import Sphere

__all__ = ["Placement", "find_up", "object_points", "object_sphere"]

Mask = Float[np.ndarray, "height width"]

INSIDE = 0.8  # of the cameras that observe a point must have it in their masks
OUTLIER = 3.0  # median distances to the 8th neighbour: a point whose own is larger is an outlier
NEIGHBOURS = 8
FEWEST_POINTS = 30
RADIUS_FACTOR = 1.1  # radii of the sphere around the points: parts of the object without points may lie outside it
MAX_TILT = np.deg2rad(20)  # largest angle between the normal of the cameras' x axes and the mean up direction
SPREAD = 4.0  # least ratio of the two smallest eigenvalues of the x axes' scatter matrix for their normal to be used
# of the ground plane: distance of its points in radii of the sphere, angle to the up direction, and share of the points
PLANE_NEAR, PLANE_LEVEL, PLANE_SHARE = 0.01, np.deg2rad(12), 0.15


@dataclass(frozen=True)
class Placement:
    """The position of the object and the up direction, in the world of structure from motion.

    Attributes:
        sphere: around the object.
        up: unit vector.
        up_from: from what the up direction was determined, as a text for the user.
    """

    sphere: Sphere
    up: Float[np.ndarray, " 3"]
    up_from: str

    def z_up_from_world(self) -> Float[np.ndarray, "4 4"]:
        """The similarity that maps the sphere to the unit sphere and the up direction to z, as in nerfstudio."""
        z = self.up / np.linalg.norm(self.up)
        x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z])
        result = np.eye(4)
        result[:3, :3] = turn / self.sphere.radius
        result[:3, 3] = -result[:3, :3] @ np.array(self.sphere.centre)
        return result


def object_points(model: SparseModel, masks: Sequence[Mask] | None) -> Bool[np.ndarray, " point"]:
    """Which points belong to the object: those inside the masks of at least 80 % of the cameras that observe them.

    Without masks, they are the points around the point nearest to all optical axes, within half the median distance of
    the cameras from it. Outliers are left out in both cases.

    Args:
        model: of structure from motion.
        masks: of the undistorted image of each camera, or None.
    """
    if masks is None:
        eyes, axes = _eyes_and_axes(model)
        centre = nearest_point(eyes, axes).numpy()
        reach = 0.5 * float(np.median(np.linalg.norm(model.centres - centre, axis=-1)))
        return _without_outliers(model.points, np.linalg.norm(model.points - centre, axis=-1) < reach)
    inside = np.zeros(len(model.observed))
    for camera, mask in enumerate(masks):
        mine = model.observed[:, 0] == camera
        seen, _ = model.project(camera, model.points[model.observed[mine, 1]])
        column, row = seen.round().astype(int)
        height, width = mask.shape
        inside[mine] = mask[row.clip(0, height - 1), column.clip(0, width - 1)] > 0.5
    count = np.bincount(model.observed[:, 1], minlength=len(model.points))
    within = np.bincount(model.observed[:, 1], inside, minlength=len(model.points))
    return _without_outliers(model.points, within >= INSIDE * np.maximum(count, 1))


def object_sphere(model: SparseModel, chosen: Bool[np.ndarray, " point"]) -> Sphere:
    """A sphere around the points of the object, a tenth larger; from the cameras alone if there are fewer than 30.

    Args:
        model: of structure from motion.
        chosen: which of its points belong to the object.
    """
    points = model.points[chosen]
    eyes, axes = _eyes_and_axes(model)
    if len(points) < FEWEST_POINTS:
        centre = nearest_point(eyes, axes)
        return Sphere(tuple(centre.tolist()), 0.4 * float((eyes - centre).norm(dim=-1).median()))
    ball = smallest_ball(torch.from_numpy(points))
    return Sphere(ball.centre, RADIUS_FACTOR * ball.radius)


def find_up(
    model: SparseModel,
    up_in_camera: Float[np.ndarray, "camera 3"],
    sphere: Sphere,
    chosen: Bool[np.ndarray, " point"],
) -> tuple[Float[np.ndarray, " 3"], str]:
    """The up direction in the world, and a text for the user on what determined it.

    There are three estimates, each better than the one before. The first is the mean of the cameras' own up directions,
    which is tilted if the cameras look down from one side. The second assumes that cameras are held level, so that the
    horizontal axes of upright images are perpendicular to the up direction; it is exact if the cameras are all around
    the object. The third is the normal of the plane that the object stands on, such as a table or a floor, if enough
    points of it were found.

    Args:
        model: of structure from motion.
        up_in_camera: the up direction of each image, in its camera.
        sphere: around the object.
        chosen: which points belong to the object.

    Returns:
        The unit vector, and the text.
    """
    rotations = model.camera_from_world[:, :3, :3]
    ups = np.einsum("cij,ci->cj", rotations, up_in_camera)
    up, source = ups.mean(0), "how the cameras were held"
    if np.linalg.norm(up) < 1e-3:
        return np.array([0.0, 0.0, 1.0]), "nothing: the cameras do not agree"
    up /= np.linalg.norm(up)
    across = np.stack([-up_in_camera[:, 1], up_in_camera[:, 0], np.zeros(len(ups))], -1)  # perpendicular in the image
    right = np.einsum("cij,ci->cj", rotations, across)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    if level @ up > np.cos(MAX_TILT) and values[1] > SPREAD * max(values[0], 1e-6):
        up, source = level, "the cameras' horizon"
    plane = _ground(model.points[~chosen], up, sphere)
    return (plane, "the plane that the object stands on") if plane is not None else (up, source)


def _eyes_and_axes(model: SparseModel) -> tuple[torch.Tensor, torch.Tensor]:
    """The centres and the optical axes of the cameras."""
    return torch.from_numpy(model.centres), torch.from_numpy(model.camera_from_world[:, 2, :3].copy())


def _without_outliers(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The chosen points without outliers, whose 8th neighbour is far away."""
    index = np.flatnonzero(chosen)
    if len(index) <= NEIGHBOURS:
        return chosen
    distance = KDTree(points[index]).query(points[index], NEIGHBOURS + 1)[0][:, -1]
    result = np.zeros_like(chosen)
    result[index[distance <= OUTLIER * np.median(distance) + 1e-12]] = True
    return result


def _ground(points: np.ndarray, up: np.ndarray, sphere: Sphere) -> np.ndarray | None:
    """The normal of a level plane under the object by RANSAC, or None if too few of the points around it lie on one."""
    offset = points - np.array(sphere.centre)
    height = offset @ up
    near = (np.linalg.norm(offset, axis=-1) < 3 * sphere.radius) & (height < 0.2 * sphere.radius)
    offset, tolerance = offset[near], PLANE_NEAR * sphere.radius
    if len(offset) < 4 * FEWEST_POINTS:
        return None
    generator = np.random.default_rng(0)
    best, most = None, max(FEWEST_POINTS, PLANE_SHARE * len(offset))
    for _ in range(500):
        first, second, third = offset[generator.choice(len(offset), 3, replace=False)]
        normal = np.cross(second - first, third - first)
        length = np.linalg.norm(normal)
        if length < 1e-12 or abs(normal @ up) < np.cos(PLANE_LEVEL) * length:
            continue
        normal *= np.sign(normal @ up) / length
        on = np.abs((offset - first) @ normal) < tolerance
        if on.sum() > most:
            best, most = on, on.sum()
    if best is None:
        return None
    flat = offset[best] - offset[best].mean(0)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    if values[1] < 0.02 * values[2]:  # the points lie on a line, which determines no plane
        return None
    normal = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return normal if normal @ up > np.cos(PLANE_LEVEL) else None
