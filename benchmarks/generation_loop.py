"""The obvious loop, which `benchmarks.generation` runs in a process of its own.

`python -m benchmarks.generation_loop COUNT OUT` prints one line of JSON. Nothing of PyTorch is imported here, for that
would count as the start of the process.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

__all__ = ["RESOLUTION", "VIEWS", "obvious_loop"]

VIEWS, RESOLUTION = 50, 128


def obvious_loop(objects: int, out: Path) -> dict[str, float]:
    """What one would write first with pyrender: a new renderer for every mesh, whose pictures it draws and writes.

    Returns:
        The number of images, the seconds until the first object was done, imports included, and those of each further.
    """
    begun = time.perf_counter()
    import numpy as np
    import pyrender
    from PIL import Image

    from data_gen.datasets.sources import Procedural, list_items
    from data_gen.meshes.mesh import prepare_scene
    from data_gen.rigs import fixed
    from data_gen.shapes import make
    from hyperplanes.utilities.axes import flip_camera_axes

    rig = fixed(VIEWS, RESOLUTION)
    ends: list[float] = []
    opengl = flip_camera_axes(rig.world_from_camera)
    focal = rig.intrinsics[0, 0, 0]
    for item in list_items(Procedural("car", objects), 0).items:
        mesh = prepare_scene(make("car", int(item.seed or 0)), item.name)
        scene = pyrender.Scene.from_trimesh_scene(mesh.scene, bg_color=[0.0, 0.0, 0.0, 0.0], ambient_light=[0.3] * 3)
        camera = scene.add(pyrender.IntrinsicsCamera(focal, focal, RESOLUTION / 2, RESOLUTION / 2))
        light = scene.add(pyrender.DirectionalLight(intensity=3.0))
        renderer = pyrender.OffscreenRenderer(RESOLUTION, RESOLUTION)
        for index, pose in enumerate(opengl):
            scene.set_pose(camera, pose)
            scene.set_pose(light, pose)
            drawn: Any = renderer.render(scene, flags=pyrender.RenderFlags.RGBA)
            path = out / item.name / f"{index:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.array(drawn[0])).save(path)
        renderer.delete()
        ends.append(time.perf_counter())
    return {
        "images": objects * VIEWS,
        "first": ends[0] - begun,
        "each": (ends[-1] - ends[0]) / max(1, objects - 1),
    }


if __name__ == "__main__":
    print(json.dumps(obvious_loop(int(sys.argv[1]), Path(sys.argv[2]))))
