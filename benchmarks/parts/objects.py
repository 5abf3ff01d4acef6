"""The objects that benchmarks render and train on."""

from __future__ import annotations

import torch

from data_gen.meshes.mesh import mesh_parts, prepare_scene
from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rigs import fixed
from data_gen.shapes import make
from hyperplanes.views import Task, Views

__all__ = ["held_out"]

FIRST_SEED = 900_000


def held_out(
    count: int, size: int, views: int = 50, device: torch.device | str = "cpu", kind: str = "car", *, first: int = 0
) -> list[Task]:
    """Procedural objects that are in no training data, rendered over white by the cameras of the fixed rig.

    Every second view is a support view; the others are query views.

    Args:
        count: number of objects.
        size: pixels per side.
        views: number of views per object.
        device: of the images.
        kind: class of the objects.
        first: how many objects to skip.
    """
    rig = fixed(views, size)
    cameras = rig.cameras(dtype=torch.float32)
    tasks = []
    renderer = MeshRenderer()
    for seed in range(FIRST_SEED + first, FIRST_SEED + first + count):
        mesh = prepare_scene(make(kind, seed), f"{kind}-{seed}")
        pixels = torch.tensor(renderer.render(mesh_parts(mesh), rig).rgba).permute(0, 3, 1, 2)
        pixels = pixels.contiguous().float() / 255  # the memory layout of images that are read from files
        masks = pixels[:, 3:]
        seen = Views(pixels[:, :3] * masks + 1 - masks, cameras, masks).to(device)
        even = torch.arange(0, views, 2)
        tasks.append(Task(seen[even], seen[even + 1], mesh.name))
    return tasks
