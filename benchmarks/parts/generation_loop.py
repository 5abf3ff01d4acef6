"""The plain loop over meshes, which `benchmarks.generation` runs in a separate process.

`python -m benchmarks.parts.generation_loop COUNT OUT` prints one line of JSON. It does not import PyTorch, because
the time of the import would count.
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
    """Render cars with pyrender in the simplest way, with a new renderer for each mesh, and write the images.

    Args:
        objects: number of cars.
        out: where the images are written.

    Returns:
        The number of images, the seconds until the first object is done, including imports, and the seconds for each
        further object.
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
