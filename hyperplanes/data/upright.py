"""Rotate views from a world with another up direction into one with y up, as in the training data of models."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.views import Task, Views

__all__ = ["UPS", "guess_up", "stated_up", "upright", "upright_cameras", "upright_task", "y_up_from"]

UPS = ("y", "z", "x", "-y", "-z", "-x")
"""Axes that may point up in a world. Another direction is written as three numbers with commas between them."""

MAX_ROLL = 0.1  # largest root mean square, over the cameras, of the sine of their roll for them to count as level


def guess_up(cameras: PinholeCamera) -> str | None:
    """An estimate of the up direction of the world, assuming that the cameras are level and not upside down.

    The x axis of a level camera is perpendicular to the up direction. The axes of the world are tried first. If none
    fits, the result is the direction that is most nearly perpendicular to the x axes of all cameras.

    Returns:
        One of UPS, or three numbers as `y_up_from` takes them; None if the cameras do not determine the direction.

    >>> guess_up(camera.pinhole(camera.symmetric_intrinsics(4, 4, 0.7), camera.orbit(9, 3.0), 4, 4))
    'y'
    """
    pose = camera.camera_from_world(cameras).detach().double().cpu()
    right, upward = pose[:, 0, :3], -pose[:, 1, :3].mean(0)
    found = {}
    for name in UPS:
        axis = _direction(name)
        if float((right @ axis).square().mean().sqrt()) < MAX_ROLL and float(upward @ axis) > MAX_ROLL:
            found[name] = float(upward @ axis)
    if found:
        return max(found, key=lambda name: found[name])
    values, vectors = torch.linalg.eigh(right.T @ right / len(right))
    axis = vectors[:, 0] * torch.sign(upward @ vectors[:, 0])
    if values[0].clamp_min(0).sqrt() > MAX_ROLL or values[1] < 4 * MAX_ROLL**2 or float(upward @ axis) <= MAX_ROLL:
        return None
    return ",".join(f"{value:.4f}" for value in axis.tolist())


def stated_up(document: dict[str, Any], path: Path) -> str | None:
    """The field "up" of a transforms.json; None if there is none.

    Returns:
        A direction as `y_up_from` takes it.

    Raises:
        DataError: the field is not such a direction.
    """
    up = document.get("up")
    if up is None:
        return None
    try:
        _direction(up if isinstance(up, str) else repr(up))
    except ValueError as error:
        raise DataError(path, "one of " + ", ".join(UPS) + " as up", repr(up)[:40], "correct the file") from error
    return up


def _direction(up: str) -> Float[Tensor, " 3"]:
    """The unit vector of one of UPS or of three numbers.

    Raises:
        ValueError: neither of these.
    """
    if up in UPS:
        axis = torch.zeros(3, dtype=torch.float64)
        axis["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
        return axis
    try:
        numbers = [float(word) for word in up.split(",")]
    except ValueError:
        numbers = []
    length = math.hypot(*numbers)
    if len(numbers) != 3 or not 0 < length < math.inf:
        raise ValueError(f"up: expected one of {', '.join(UPS)}, or three numbers such as 0,0.1,1, got {up!r}")
    return torch.tensor(numbers, dtype=torch.float64) / length


def y_up_from(up: str) -> Float[Tensor, "4 4"]:
    """The smallest rotation from a world with that up direction to one with y up.

    Args:
        up: one of UPS, or three numbers with commas between them.

    Returns:
        A rigid transform in float64, which rotates about x if `up` is z or -y. Raises ValueError for another `up`.

    >>> (y_up_from("z") @ torch.tensor([1.0, 2.0, 3.0, 1.0], dtype=torch.float64)).tolist()
    [1.0, 3.0, -2.0, 1.0]
    """
    x, y, z = _direction(up).tolist()
    turn = torch.eye(4, dtype=torch.float64)
    if y < -1 + 1e-12:
        turn[1, 1] = turn[2, 2] = -1.0
        return turn
    a, b = 1 / (1 + y), -x * z / (1 + y)  # Rodrigues' formula about the axis up x (0, 1, 0)
    rows = [[1 - x * x * a, -x, b], [x, y, z], [b, -z, 1 - z * z * a]]
    turn[:3, :3] = torch.tensor(rows, dtype=torch.float64) + 0.0
    return turn


def upright(views: Views, up: str) -> Views:
    """The same views in a world with y up. Cameras and bounds are rotated together.

    Args:
        views: in a world in which `up` points up.
        up: as in `y_up_from`.

    Returns:
        The views, which share their images and masks with the given ones.
    """
    turn = y_up_from(up)
    if up == "y":
        return views if views.up in (None, "y") else replace(views, up="y")
    cameras = upright_cameras(views.cameras, up)
    x, y, z = (turn[:3, :3] @ torch.tensor(views.bounds.centre, dtype=torch.float64)).tolist()
    return replace(views, cameras=cameras, bounds=Sphere((x, y, z), views.bounds.radius), up=views.up and "y")


def upright_cameras(cameras: PinholeCamera, up: str) -> PinholeCamera:
    """The same cameras in a world with y up, rotated as by `upright`."""
    pose = camera.camera_from_world(cameras)
    return camera.with_poses(cameras, pose @ y_up_from(up).T.to(pose))  # camera from old world, old world from new


def upright_task(task: Task, up: str) -> Task:
    """Support and query of a task in a world with y up."""
    return Task(upright(task.support, up), upright(task.query, up), task.name)
