"""Time the same work with one, two and all threads, on an idle machine and while other processes use every core.

    python -m benchmarks busy --json FILE

Each setting runs in its own process, because OpenMP reads its wait policy when PyTorch is loaded: "passive", as
`import hyperplanes` sets it, or "active", the default of PyTorch. The cores that a process gets differ between
processes, so that each setting is measured in several. The reference of every row is one thread under the same load.
More threads should never be slower than one.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import ratio
from hyperplanes.utilities.machine.environment import usable_cores

if TYPE_CHECKING:
    from hyperplanes.adaptation import HyperPlanes
    from hyperplanes.views import Task

__all__ = ["main"]

WORKS = ("lookup", "carving", "rendering", "fine_tuning", "training")
SPIN = "while True: pass"
WARM, SHORTEST = 0.5, 1.0  # seconds of work before the first measurement; least seconds of all repetitions


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks busy", description=__doc__)
    parser.add_argument("--works", nargs="+", choices=WORKS, default=list(WORKS))
    parser.add_argument("--policies", nargs="+", choices=("passive", "active"), default=["passive"])
    parser.add_argument("--repeats", type=positive, default=3, help="repetitions per process (default: %(default)s)")
    parser.add_argument(
        "--rounds", type=positive, default=3, help="processes per setting, interleaved (default: %(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="little work, measured once, to check that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    parser.add_argument("--measure", choices=WORKS, help=argparse.SUPPRESS)  # internal: what the measured processes do
    chosen = parser.parse_args(arguments)
    if chosen.measure:
        print(json.dumps(_seconds(chosen.measure, 1 if chosen.quick else chosen.repeats, chosen.quick)))
        return 0
    cores = usable_cores()
    counts, rows = sorted({1, 2, cores}), []
    for load, spinning in (("idle", 0), ("busy", cores)):
        for work in chosen.works:
            for policy in chosen.policies:
                times: dict[int, list[float]] = {count: [] for count in counts}
                for _ in range(1 if chosen.quick else chosen.rounds):
                    with _busy(spinning):
                        for count in counts:
                            times[count].append(statistics.median(_in_process(work, count, policy, chosen)))
                for count, seconds in times.items():
                    row: Row = {"name": work, "load": load, "policy": policy, "threads": count}
                    row |= {"seconds": statistics.median(seconds), **ratio(times[1], seconds)}
                    rows.append(row)
    return finish("busy", rows, chosen.json)


@contextmanager
def _busy(count: int) -> Generator[None]:
    """While active, `count` other processes run busy loops."""
    others = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def _in_process(work: str, threads: int, policy: str, chosen: argparse.Namespace) -> list[float]:
    """The seconds of every repetition in a new process with this number of threads and this wait policy."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": policy.upper()}
    environment.pop("GOMP_SPINCOUNT", None)
    command = [sys.executable, "-m", "benchmarks", "busy", "--measure", work, "--repeats", str(chosen.repeats)]
    command += ["--quick"] if chosen.quick else []
    run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def _seconds(name: str, repeats: int, quick: bool) -> list[float]:
    """The wall time of every repetition in seconds.

    Unmeasured repetitions come first: they fill caches, compile kernels and wake idle cores.
    """
    work, times = _work(name, quick), []
    work()
    warm, begun = time.perf_counter() + (0 if quick else WARM), time.perf_counter()
    while begun < warm:
        work()
        begun = time.perf_counter()
    while len(times) < repeats or sum(times) < (0 if quick else SHORTEST):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return times


def _work(name: str, quick: bool) -> Callable[[], object]:
    """A function that does one repetition of the named work, with the packaged scene and model."""
    import torch

    from hyperplanes.adaptation.base import hull
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.data import read_task
    from hyperplanes.geometry import ImagePlanes

    task = read_task("example-car")
    if name == "lookup":
        planes = ImagePlanes(task.support.images, task.support.cameras)
        points = torch.rand(2_000 if quick else 65_536, 3, generator=torch.Generator().manual_seed(0)) - 0.5
        return lambda: planes.lookup(points)
    if name == "carving":
        return lambda: hull(task.support, 32 if quick else 96)
    model = HyperPlanes.from_pretrained("small")
    if name == "fine_tuning":
        return lambda: model.fine_tune(task.support, 1 if quick else 5)
    if name == "training":
        return _training(model, task)
    field, cameras = model.adapt(task.support).without_residuals(), task.query[: 1 if quick else 4].cameras
    return lambda: field.render(cameras)


def _training(model: HyperPlanes, task: Task) -> Callable[[], object]:
    """A function that takes one training step of the packaged model, with ten views of each object."""
    from benchmarks.training import UNSEEN, Objects
    from hyperplanes.configuration.presets import preset
    from hyperplanes.training import Trainer

    config = replace(preset("small").training, views=(10,))
    objects = Objects([replace(task, name=f"{name}") for name in range(config.tasks + UNSEEN)])
    return Trainer(model, objects, config).take_step
