"""Views of a world with another axis up, brought into ours: y up, as models are trained."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Task, Views

__all__ = ["UPS", "upright", "upright_task", "y_up_from"]

UPS = ("y", "z")
"""Axes that may be up in a world."""


def y_up_from(up: str) -> Float[Tensor, "4 4"]:
    """The rotation that takes a world with that axis up to one with y up; x stays where it is.

    Args:
        up: one of UPS.

    Returns:
        A rotation of 0 or -90 degrees about x, in float64.

    Raises:
        ValueError: another axis.

    >>> (y_up_from("z") @ torch.tensor([1.0, 2.0, 3.0, 1.0], dtype=torch.float64)).tolist()
    [1.0, 3.0, -2.0, 1.0]
    """
    if up not in UPS:
        raise ValueError(f"up: expected one of {', '.join(UPS)}, got {up!r}")
    if up == "y":
        return torch.eye(4, dtype=torch.float64)
    rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def upright(views: Views, up: str) -> Views:
    """The same pictures in a world with y up: cameras and bounds are turned together, so every ray sees what it saw.

    Args:
        views: of a world in which `up` points up.
        up: one of UPS.

    Returns:
        The views; images and masks are shared with the ones given.
    """
    turn = y_up_from(up)
    if up == "y":
        return views
    pose = camera.camera_from_world(views.cameras)
    turned = pose @ turn.T.to(pose)  # camera from old world, after old world from new
    cameras = camera.with_poses(views.cameras, turned)
    x, y, z = (turn[:3, :3] @ torch.tensor(views.bounds.centre, dtype=torch.float64)).tolist()
    return replace(views, cameras=cameras, bounds=Sphere((x, y, z), views.bounds.radius))


def upright_task(task: Task, up: str) -> Task:
    """Support and query of a task in a world with y up."""
    return Task(upright(task.support, up), upright(task.query, up), task.name)
