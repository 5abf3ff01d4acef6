"""What `benchmarks.generation` runs in processes of their own: the obvious loop, and our stages one by one.

`python -m benchmarks.generation_parts loop|stages COUNT OUT` prints one line of JSON. Nothing of PyTorch is imported
here, for that would count as the start of the process.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

__all__ = ["RESOLUTION", "VIEWS", "obvious_loop", "stages"]

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


def stages(objects: int, out: Path) -> dict[str, float]:
    """Where our time goes: milliseconds of processor time a picture of each thing that a worker does.

    Args:
        objects: how many cars; one more is drawn before, unmeasured.

    Returns:
        Milliseconds by stage; and the seconds of processor time that the process took to start.
    """
    from data_gen import SUPERSAMPLE
    from data_gen.datasets.layouts import LAYOUTS, RenderedObject
    from data_gen.datasets.sources import Procedural, list_items
    from data_gen.meshes.mesh import mesh_parts, prepare_scene
    from data_gen.rendering.mesh_renderer import MeshRenderer
    from data_gen.rendering.renderers import find_renderer
    from data_gen.rigs import fixed
    from data_gen.shapes import make
    from hyperplanes.utilities.encoding import sha256
    from hyperplanes.utilities.writing import write_folder

    rig = fixed(VIEWS, RESOLUTION)
    spent = dict.fromkeys(("mesh", "one sample a pixel drawn", "nine samples a pixel drawn", "png", "written"), 0.0)
    with MeshRenderer(find_renderer().name) as renderer:
        sparse = MeshRenderer(renderer.name, 1)
        for index, item in enumerate(list_items(Procedural("car", objects + 1), 0).items):
            if index == 1:
                started = time.process_time()
                spent = dict.fromkeys(spent, 0.0)
            marks = [time.process_time()]
            mesh = prepare_scene(make("car", int(item.seed or 0)), item.name, closed=True)
            marks.append(time.process_time())
            parts = mesh_parts(mesh)
            sparse.render(parts, rig)
            marks.append(time.process_time())
            rgba = renderer.render(parts, rig).rgba
            assert rgba is not None
            marks.append(time.process_time())
            files = LAYOUTS["native"].files(RenderedObject(item, rig, rgba))
            marks.append(time.process_time())
            for data in files.values():
                sha256(data)
            write_folder(out / item.name, {name.partition("/")[2]: data for name, data in files.items()}, out)
            marks.append(time.process_time())
            for stage, begin, end in zip(spent, marks, marks[1:], strict=False):
                spent[stage] += end - begin
    assert SUPERSAMPLE == 3
    milliseconds = {stage: 1e3 * seconds / objects / VIEWS for stage, seconds in spent.items()}
    return milliseconds | {"start": started}


if __name__ == "__main__":
    run = {"loop": obvious_loop, "stages": stages}[sys.argv[1]]
    print(json.dumps(run(int(sys.argv[2]), Path(sys.argv[3]))))
