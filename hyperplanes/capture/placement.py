"""Where the object of a capture is, and which way is up."""

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

INSIDE = 0.8  # of the cameras that observed a point must show it within their masks
STRAY = 3.0  # times the median distance to its neighbours, from which on a point belongs to nothing
NEIGHBOURS = 8
FEWEST_POINTS = 30
MARGIN = 1.1  # of the sphere around the points, for what has none
LEVEL = np.deg2rad(20)  # within which the cameras' horizon must agree with how they were held
SPREAD = 4.0  # how much better than in any other direction the horizon must fit
PLANE_NEAR, PLANE_LEVEL, PLANE_SHARE = 0.01, np.deg2rad(12), 0.15


@dataclass(frozen=True)
class Placement:
    """An object in the world of its capture.

    Attributes:
        sphere: around it.
        up: unit vector.
        up_from: what told which way is up, in words.
    """

    sphere: Sphere
    up: Float[np.ndarray, " 3"]
    up_from: str

    def z_up_from_world(self) -> Float[np.ndarray, "4 4"]:
        """The similarity after which the sphere is the unit sphere, and z is up as in nerfstudio's worlds."""
        z = self.up / np.linalg.norm(self.up)
        x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z])
        result = np.eye(4)
        result[:3, :3] = turn / self.sphere.radius
        result[:3, 3] = -result[:3, :3] @ np.array(self.sphere.centre)
        return result


def object_points(model: SparseModel, masks: Sequence[Mask] | None) -> Bool[np.ndarray, " point"]:
    """Which points belong to the object: those that nearly all of their cameras show within their masks.

    Without masks, those within half the distance between the cameras and the place that they look at.

    Args:
        model: of structure from motion.
        masks: of each camera's picture without its lens, or None.
    """
    if masks is None:
        eyes, axes = _eyes_and_axes(model)
        centre = nearest_point(eyes, axes).numpy()
        reach = 0.5 * float(np.median(np.linalg.norm(model.centres - centre, axis=-1)))
        return _without_strays(model.points, np.linalg.norm(model.points - centre, axis=-1) < reach)
    inside = np.zeros(len(model.observed))
    for camera, mask in enumerate(masks):
        mine = model.observed[:, 0] == camera
        seen, _ = model.project(camera, model.points[model.observed[mine, 1]])
        column, row = seen.round().astype(int)
        height, width = mask.shape
        inside[mine] = mask[row.clip(0, height - 1), column.clip(0, width - 1)] > 0.5
    count = np.bincount(model.observed[:, 1], minlength=len(model.points))
    within = np.bincount(model.observed[:, 1], inside, minlength=len(model.points))
    return _without_strays(model.points, within >= INSIDE * np.maximum(count, 1))


def object_sphere(model: SparseModel, chosen: Bool[np.ndarray, " point"]) -> Sphere:
    """A sphere around points, a tenth larger; from the cameras alone where there are too few of them.

    Args:
        model: of structure from motion.
        chosen: its points that belong to the object.
    """
    points = model.points[chosen]
    eyes, axes = _eyes_and_axes(model)
    if len(points) < FEWEST_POINTS:
        centre = nearest_point(eyes, axes)
        return Sphere(tuple(centre.tolist()), 0.4 * float((eyes - centre).norm(dim=-1).median()))
    ball = smallest_ball(torch.from_numpy(points))
    return Sphere(ball.centre, MARGIN * ball.radius)


def find_up(
    model: SparseModel,
    up_in_camera: Float[np.ndarray, "camera 3"],
    sphere: Sphere,
    chosen: Bool[np.ndarray, " point"],
) -> tuple[Float[np.ndarray, " 3"], str]:
    """Which way is up, and what told it.

    The mean of what the cameras call up leans towards where they look down from. People hold cameras level: the
    horizontal axes of their pictures are perpendicular to up, which is exact where the cameras stand around the
    object. Where the object stands on a plane that is seen, as a table or a floor, its normal is better still.

    Args:
        model: of structure from motion.
        up_in_camera: which way is up in each picture.
        sphere: around the object.
        chosen: the points of the object.
    """
    rotations = model.camera_from_world[:, :3, :3]
    ups = np.einsum("cij,ci->cj", rotations, up_in_camera)
    up, source = ups.mean(0), "how the cameras were held"
    if np.linalg.norm(up) < 1e-3:
        return np.array([0.0, 0.0, 1.0]), "nothing: the cameras do not agree"
    up /= np.linalg.norm(up)
    across = np.stack([-up_in_camera[:, 1], up_in_camera[:, 0], np.zeros(len(ups))], -1)  # perpendicular in the picture
    right = np.einsum("cij,ci->cj", rotations, across)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    if level @ up > np.cos(LEVEL) and values[1] > SPREAD * max(values[0], 1e-6):
        up, source = level, "the cameras' horizon"
    plane = _ground(model.points[~chosen], up, sphere)
    return (plane, "the plane that the object stands on") if plane is not None else (up, source)


def _eyes_and_axes(model: SparseModel) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(model.centres), torch.from_numpy(model.camera_from_world[:, 2, :3].copy())


def _without_strays(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The same without points far from all others of them."""
    index = np.flatnonzero(chosen)
    if len(index) <= NEIGHBOURS:
        return chosen
    distance = KDTree(points[index]).query(points[index], NEIGHBOURS + 1)[0][:, -1]
    result = np.zeros_like(chosen)
    result[index[distance <= STRAY * np.median(distance) + 1e-12]] = True
    return result


def _ground(points: np.ndarray, up: np.ndarray, sphere: Sphere) -> np.ndarray | None:
    """The normal of the level plane under the object that enough of the points around it lie on, or None."""
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
    if values[1] < 0.02 * values[2]:  # a line is no plane
        return None
    normal = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return normal if normal @ up > np.cos(PLANE_LEVEL) else None
