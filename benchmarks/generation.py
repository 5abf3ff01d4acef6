"""Compare the speed of data set generation with a plain loop: one process, and a new pyrender renderer per mesh.

Both make the same procedural cars, render the same 50 views of each at 128x128, and write RGBA PNGs. Both times include
starting their processes, but not the one-time search for a renderer. Rounds of both alternate and take about equally
long, so that other processes disturb both equally. The loop uses the default multisampling of pyrender, four samples
per pixel of which one is shaded; `data_gen` shades each of four, or of nine, the default.

Speed is measured in wall time and in processor time. Processor time counts the work of all processes on all cores, and
other processes disturb it less. `load` is the load average, including this benchmark. The time for 1,000 objects is
extrapolated from the time until the first object is done and the time for each further one.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.parts.generation_loop import RESOLUTION, VIEWS
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import ratio
from data_gen import SUPERSAMPLE
from hyperplanes.utilities.machine.environment import usable_cores

__all__ = ["main"]

THOUSAND = 1000


@dataclass(frozen=True)
class Run:
    """The times of one generation.

    Attributes:
        images: number of images that it wrote.
        wall: wall time in seconds.
        processor: processor time of all its processes in seconds.
        first: seconds until the first object was done.
        each: seconds for each further object.
    """

    images: int
    wall: float
    processor: float
    first: float = 0.0
    each: float = 0.0


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks generation", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer objects and rounds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    options = parser.parse_args(arguments)
    from data_gen.rendering.renderers import find_renderer

    renderer = find_renderer().name
    with tempfile.TemporaryDirectory() as folder:
        rows = compare(renderer, Path(folder), rounds=2 if options.quick else 5, objects=24 if options.quick else 60)
        rows.append(memory(60 if options.quick else THOUSAND, Path(folder)))
    return finish("generation", rows, options.json)


def compare(renderer: str, folder: Path, *, rounds: int, objects: int) -> list[Row]:
    """Images per second of `data_gen.datasets.generate.generate` and of the plain loop, which needs OpenGL.

    Args:
        renderer: a name in `data_gen.rendering.renderers.RENDERERS`; without one of pyrender, the loop does not run.
        folder: where the images are written.
        rounds: number of rounds.
        objects: number of objects that `generate` makes per round; the loop makes a sixth of it.

    Returns:
        A row for each number of samples per pixel, with `speedup` and its quartiles over the rounds, and a row with the
        time for 1,000 objects.
    """
    counts = (2, SUPERSAMPLE)
    ours: dict[int, list[Run]] = {supersample: [] for supersample in counts}
    loop: list[Run] = []
    # Nothing is deleted between rounds, because ext4 takes long to find a free inode among recently deleted ones.
    for turn in range(rounds):
        if renderer.startswith("pyrender"):
            loop.append(looped(objects // 6, folder / f"loop{turn}", renderer))
        for supersample in counts:
            ours[supersample].append(generated(objects, folder / f"ours{supersample}_{turn}", supersample))
    rows: list[Row] = []
    for supersample, runs in ours.items():
        row: Row = {"name": f"generate, {supersample**2} samples a pixel", "renderer": renderer, "rounds": rounds}
        row |= {"workers": usable_cores(), "objects": objects, "load": os.getloadavg()[0], **_speed(runs)}
        if loop:
            row |= {f"reference_{key}": value for key, value in _speed(loop).items()}
            row |= ratio(*([run.wall / run.images for run in side] for side in (loop, runs)))
            processor = ratio(*([run.processor / run.images for run in side] for side in (loop, runs)))
            row["processor_speedup"] = processor["speedup"]
        rows.append(row)
    seconds, theirs = ([run.first + (THOUSAND - 1) * run.each for run in runs] for runs in (ours[SUPERSAMPLE], loop))
    last: Row = {"name": "1,000 objects x 50 views at 128x128", "seconds_extrapolated": statistics.median(seconds)}
    if theirs:
        last |= {"reference_seconds_extrapolated": statistics.median(theirs), **ratio(theirs, seconds)}
    return [*rows, last]


def _speed(runs: list[Run]) -> Row:
    """Medians over the rounds."""
    return {
        "images_per_second": statistics.median(run.images / run.wall for run in runs),
        "processor_milliseconds_an_image": statistics.median(1e3 * run.processor / run.images for run in runs),
    }


def measured(run: Callable[[], int]) -> Run:
    """The times of a generation. `run` returns how many images it wrote."""
    begun, computed = time.perf_counter(), _computed()
    images = run()
    wall, processor = time.perf_counter() - begun, _computed() - computed
    return Run(images, wall, processor)


def _computed() -> float:
    """Processor seconds of this process and all its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def generated(objects: int, out: Path, supersample: int = SUPERSAMPLE) -> Run:
    """The times of `data_gen.datasets.generate.generate` for cars, with one worker per core.

    Args:
        objects: number of cars.
        out: where the images are written.
        supersample: samples per pixel along each axis.
    """
    from data_gen.datasets.generate import GenerationConfig, Procedural, generate

    ends: list[float] = []

    def run() -> int:
        config = GenerationConfig(views=VIEWS, resolution=RESOLUTION, supersample=supersample, held_out=0)
        generate(Procedural("car", objects), out, config, progress=lambda *_: ends.append(time.perf_counter()))
        return objects * VIEWS

    begun = time.perf_counter()
    whole = measured(run)
    each = (ends[-1] - ends[0]) / max(1, len(ends) - 1)
    return Run(whole.images, whole.wall, whole.processor, ends[0] - begun, each)


def looped(objects: int, out: Path, renderer: str) -> Run:
    """The times of the plain loop, in a separate process.

    Args:
        objects: number of cars.
        out: where the images are written.
        renderer: one of the renderers of pyrender.
    """
    told: dict[str, float] = {}

    def run() -> int:
        out.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "benchmarks.parts.generation_loop", str(objects), str(out)]
        platform = {"PYOPENGL_PLATFORM": renderer.removeprefix("pyrender-")}
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=os.environ | platform)
        told.update(json.loads(done.stdout.splitlines()[-1]))
        return int(told["images"])

    whole = measured(run)
    return replace(whole, first=told["first"], each=told["each"])


def memory(objects: int, folder: Path) -> Row:
    """The memory of the parent process and its workers during the generation of many small objects.

    Workers are not recycled, so that a memory leak shows.

    Args:
        objects: number of objects, with 2 views of 32x32 each.
        folder: where the images are written.

    Returns:
        A row with medians of the resident memory in MiB over the second and the last tenth of the objects, and its
        growth per object.
    """
    from data_gen.datasets.generate import GenerationConfig, Procedural, generate

    sizes: list[float] = []
    config = GenerationConfig(views=2, resolution=32, held_out=0, recycle=objects)
    cars = Procedural("car", objects)
    generate(cars, folder / "stream", config, progress=lambda *_: sizes.append(resident_megabytes()))
    tenth = max(1, len(sizes) // 10)
    early, late = statistics.median(sizes[tenth : 2 * tenth]), statistics.median(sizes[-tenth:])
    return {
        "name": f"memory over {objects} objects",
        "early_megabytes": early,
        "late_megabytes": late,
        "growth_megabytes_an_object": (late - early) / objects,
    }


def resident_megabytes() -> float:
    """Resident memory of this process and its children, in MiB."""
    processes = [os.getpid()]
    for task in Path("/proc/self/task").iterdir():
        processes += map(int, (task / "children").read_text().split())
    total = 0
    for process in processes:
        try:
            total += int(Path(f"/proc/{process}/statm").read_text().split()[1])
        except FileNotFoundError:
            continue  # the process has ended
    return total * os.sysconf("SC_PAGE_SIZE") / 2**20
