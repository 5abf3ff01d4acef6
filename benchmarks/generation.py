"""How fast data sets are generated, against the obvious loop: one process, a new pyrender renderer for every mesh.

Both make the same procedural cars, draw the same 50 views of each at 128x128, and write RGBA PNGs; both times include
the start of the processes. The loop draws with what pyrender does by itself, four samples a pixel of which one is
shaded, in a process of its own; ours is measured with four samples a pixel, all shaded, and with nine, the default.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.reporting import Row, finish
from data_gen import SUPERSAMPLE

__all__ = ["main"]

VIEWS, RESOLUTION = 50, 128
THOUSAND = 1000


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them as JSON where asked.

    Args:
        arguments: --quick for a rough answer in about a minute, --json FILE, or (inside) --loop COUNT OUT.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks generation", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer objects")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the rows go")
    parser.add_argument("--loop", nargs=2, metavar=("COUNT", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.loop:
        print(json.dumps(obvious_loop(int(options.loop[0]), Path(options.loop[1]))))
        return 0
    objects = 8 if options.quick else 40
    with tempfile.TemporaryDirectory() as folder:
        rows = compare(objects, Path(folder))
        rows += [extrapolate(rows[-1]), memory(24 if options.quick else THOUSAND, Path(folder))]
    return finish("generation", rows, options.json)


def compare(objects: int, folder: Path) -> list[Row]:
    """Images a second of `data_gen.dataset.generate` and of the obvious loop.

    Args:
        objects: how many ours makes; the loop makes a quarter, at least four.
        folder: where they write.

    Returns:
        A row for each number of samples; `speedup` is ours over theirs.
    """
    from data_gen.backends import find_backend
    from data_gen.dataset import Procedural, generate

    renderer = find_backend().name
    workers = len(os.sched_getaffinity(0))
    reference = loop_rate(max(4, objects // 4), folder, renderer)
    rows: list[Row] = []
    for supersample in (2, SUPERSAMPLE):
        begun = time.perf_counter()
        generate(
            Procedural("car", objects),
            folder / f"ours{supersample}",
            views=VIEWS,
            resolution=RESOLUTION,
            held_out=0,
            workers=workers,
            supersample=supersample,
        )
        ours = objects * VIEWS / (time.perf_counter() - begun)
        row: Row = {"name": f"generate, {supersample**2} samples a pixel", "objects": objects}
        row |= {"renderer": renderer, "workers": workers, "images_per_second": ours}
        if reference is not None:
            row |= {"reference_images_per_second": reference, "speedup": ours / reference}
        rows.append(row)
    return rows


def loop_rate(objects: int, folder: Path, renderer: str) -> float | None:
    """Images a second of the obvious loop; None without OpenGL, which it needs.

    Args:
        objects: how many it makes.
        folder: where it writes.
        renderer: a name in `data_gen.backends.BACKENDS`.
    """
    if not renderer.startswith("pyrender"):
        return None
    command = [sys.executable, "-m", "benchmarks", "generation", "--loop", str(objects), str(folder / "loop")]
    environment = os.environ | {"PYOPENGL_PLATFORM": renderer.removeprefix("pyrender-")}
    done = subprocess.run(command, check=True, capture_output=True, env=environment)
    loop = json.loads(done.stdout.splitlines()[-1])
    return loop["images"] / loop["seconds"]


def extrapolate(row: Row) -> Row:
    """The time that 1,000 objects of 50 views would take at a measured rate; extrapolated, not measured."""
    seconds = THOUSAND * VIEWS / float(row["images_per_second"])
    return {"name": "1,000 objects x 50 views at 128x128", "seconds_extrapolated": seconds}


def memory(objects: int, folder: Path) -> Row:
    """The memory of parent and workers while many small objects stream through, workers not recycled.

    Args:
        objects: how many, with 2 views of 32x32 each.
        folder: where they are written.

    Returns:
        Medians of the resident memory in MB over the second and the last tenth of the objects, and the growth.
    """
    from data_gen.dataset import Procedural, generate

    sizes: list[float] = []
    generate(
        Procedural("car", objects),
        folder / "stream",
        views=2,
        resolution=32,
        held_out=0,
        recycle=objects,
        progress=lambda *_: sizes.append(resident_megabytes()),
    )
    tenth = max(1, len(sizes) // 10)
    early, late = statistics.median(sizes[tenth : 2 * tenth]), statistics.median(sizes[-tenth:])
    return {
        "name": f"memory over {objects} objects",
        "early_megabytes": early,
        "late_megabytes": late,
        "growth_megabytes_an_object": (late - early) / objects,
    }


def resident_megabytes() -> float:
    """Resident memory of this process and its children."""
    processes = [os.getpid()]
    for task in Path("/proc/self/task").iterdir():
        processes += map(int, (task / "children").read_text().split())
    total = 0
    for process in processes:
        try:
            total += int(Path(f"/proc/{process}/statm").read_text().split()[1])
        except FileNotFoundError:
            continue  # it has ended meanwhile
    return total * os.sysconf("SC_PAGE_SIZE") / 2**20


def obvious_loop(objects: int, out: Path) -> dict[str, float]:
    """What one would write first with pyrender.

    Args:
        objects: how many cars.
        out: where the pictures go.

    Returns:
        The number of images and the seconds they took.
    """
    begun = time.perf_counter()
    import numpy as np
    import pyrender
    from PIL import Image

    from data_gen.meshes import prepare_scene
    from data_gen.rigs import fixed
    from data_gen.shapes import make
    from data_gen.sources import Procedural, list_items

    rig = fixed(VIEWS, RESOLUTION)
    opengl = rig.world_from_camera * [1.0, -1.0, -1.0, 1.0]
    focal = rig.intrinsics[0, 0, 0]
    for item in list_items(Procedural("car", objects), 0):
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
    return {"images": objects * VIEWS, "seconds": time.perf_counter() - begun}
