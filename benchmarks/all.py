"""Run all benchmarks; write rows and figures to benchmarks/results, and the tables of the documentation.

    python -m benchmarks all
    python -m benchmarks all --root data --data data/cars data/chairs --scene chair --meshes miner.glb taxi.glb

Each benchmark runs in its own process, and writes the commit, the hardware and the load with its rows. Benchmarks of
speed run first, one at a time. Benchmarks of quality then run in parallel, so that their times mean little. Those that
evaluate or train models need data sets: the suites of `benchmarks/views.py` in the folder --root, and the data sets of
--data. Without --scene and --meshes, procedural objects replace the objects that the documentation shows.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from benchmarks import tables
from benchmarks.parts.load import OF_SPEED
from benchmarks.parts.options import positive
from benchmarks.parts.view_tables import OF_CORRECTION
from hyperplanes.utilities.machine.environment import usable_cores

__all__ = ["COMMANDS", "OF_DATA", "OF_GPU", "OF_SUITES", "main"]

RESULTS = Path(__file__).parent / "results"
COMMANDS: dict[str, list[str]] = {
    "adapting": ["--side", "192"],
    "lookup": [],
    "visibility": [],
    "busy": [],
    "rendering": [],
    "small": [],
    "splats": [],
    "steps": [],
    "training": [],
    "training_curves": ["--curves", "120"],
    "generation": [],
    "captures": ["--checkpoint", "small", "--size", "640"],
}
"""The names of results, and the options of their benchmarks other than --json and --plot."""

OF_GPU = {"gpu": ["--compile"], "lookup_gpu": ["--device", "cuda"]}
"""Likewise, for results that need a CUDA device."""

OF_DATA = ("views", "baked", "image_based", "hypernetwork")
"""Benchmarks that read the data sets of --data."""

MORE = {"baked": ["--objects", "2", "--query", "4", "--counts", "25", "3"]}
"""The options of these benchmarks other than --data."""

_METHODS = ["--methods", "nearest_view", "hull_blend", "hull_blend_reflected", "unreflected"]
_TEN = ["--objects", "10", "--query", "2", "--counts", "1", "3", "5", "25", *_METHODS, *OF_CORRECTION]
_TUNED = ["--counts", "3", "25", "--query", "2", "--steps", "100", "--methods", "hull_blend"]
OF_SUITES: dict[str, tuple[list[str], list[str]]] = {
    "views_procedural": (["procedural"], _TEN),
    "views_cc0": (["cc0"], _TEN),
    "views_random": (["random"], [*_TEN, "swapped"]),
    "views_posed": (
        ["posed"],
        ["--query", "5", "--counts", "1", "3", "5", "25", "50", *_METHODS, *OF_CORRECTION],
    ),
    "views_srn": (["srn"], ["--inputs", "64", "--query", "10", "--objects", "10", *_METHODS]),
    "views_srn_2": (["srn"], ["--inputs", "64", "128", "--query", "10", "--objects", "10", *_METHODS]),
    "views_rotated": (
        ["procedural", "cc0"],
        ["--objects", "5", "--query", "2", "--counts", "2", "3", "5", "12", "--rotated", "33"]
        + ["--methods", "hull_blend", "hull_blend_reflected", "unreflected", "unrotated"],
    ),
    "views_tuned": (["procedural", "cc0", "random"], ["--objects", "10", "--seeds", "3", *_TUNED]),
    "views_tuned_posed": (["posed"], ["--seeds", "5", *_TUNED]),
}
"""Results of `views` on suites, with the suites and the other options; with --root they replace `views` on --data."""

PLOTTED = {"lookup": "lookup.png", "rendering": "rendering.png", "training_curves": "training_curves.png"}
"""Figures of results, in the same folder."""


def main(arguments: list[str]) -> int:
    """Run all benchmarks, and print which of them failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks all", description=__doc__)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results (default: %(default)s)")
    parser.add_argument("--data", type=Path, nargs="+", default=[],
                        help=f"data sets for {', '.join(OF_DATA)}; steps and gpu use the first one")  # fmt: skip
    parser.add_argument("--root", type=Path, help="folder with the data sets of the suites")
    parser.add_argument("--scene", type=Path, help="posed images for adapting and, with --data, for baked")
    parser.add_argument("--meshes", type=Path, nargs="+", help="mesh files for captures")
    parser.add_argument("--quick", action="store_true", help="run each with --quick, to check that it runs")
    parser.add_argument("--under-load", action="store_true", help="measure even if other processes are busy")
    parser.add_argument("--workers", type=positive, default=usable_cores(), help="how many benchmarks of quality run "
                        "in parallel; those of speed run alone, before them (default: %(default)s)")  # fmt: skip
    chosen = parser.parse_args(arguments)
    commands = _commands(chosen)
    of_speed = {name: options for name, (benchmark, options) in commands.items() if benchmark in OF_SPEED}
    others = {name: options for name, (_, options) in commands.items() if name not in of_speed}
    threads = {"OMP_NUM_THREADS": str(max(1, usable_cores() // chosen.workers))}
    failed = _run(of_speed, 1, {}) + _run(others, chosen.workers, threads)
    print(f"benchmarks all: {len(commands) - len(failed)} of {len(commands)} done", *failed, sep="; failed: ")
    if not chosen.data:
        print(f"benchmarks all: without --data, {', '.join(OF_DATA)} did not run")
    if chosen.out == RESULTS and not chosen.quick:
        tables.main([])
    return 1 if failed else 0


def _run(commands: dict[str, list[str]], workers: int, settings: dict[str, str]) -> list[str]:
    """Run commands, print how long each took, and return the names of those that failed.

    Args:
        commands: by the names of their results.
        workers: how many run in parallel.
        settings: environment variables, unless they are set already.
    """

    def failed(name: str) -> bool:
        begun = time.perf_counter()
        found = subprocess.run(commands[name], check=False, env=settings | os.environ)
        print(f"benchmarks all: {name} took {time.perf_counter() - begun:.0f} s", flush=True)
        return found.returncode != 0

    pool = ThreadPoolExecutor(workers)
    try:
        return [name for name, bad in zip(commands, pool.map(failed, commands), strict=True) if bad]
    finally:
        pool.shutdown(cancel_futures=True)  # after an interrupt, the others do not start


def _commands(chosen: argparse.Namespace) -> dict[str, tuple[str, list[str]]]:
    """The name of the benchmark that makes each result, and its command."""
    data, scene = ["--data", *map(str, chosen.data)], [str(chosen.scene)] if chosen.scene else []
    first = data[:2] if chosen.data else []
    given = {"adapting": ["--views", *scene] if scene else [], "steps": first, "gpu": first}
    given["baked"] = [*data, *scene]
    given["captures"] = ["--meshes", *map(str, chosen.meshes)] if chosen.meshes else []
    made = COMMANDS | OF_GPU if torch.cuda.is_available() else COMMANDS
    whose = {name: re.sub("_curves$|_gpu$", "", name) for name in made}
    commands = {name: (whose[name], given.get(name, []), more) for name, more in made.items()}
    if chosen.data:
        commands |= {name: (name, given.get(name, data), MORE.get(name, [])) for name in OF_DATA}
    if chosen.root:
        commands.pop("views", None)
        for name, (suites, more) in OF_SUITES.items():
            commands[name] = "views", ["--root", str(chosen.root), "--suite", *suites], more
    result = {}
    for name, (benchmark, source, more) in commands.items():
        plot = ["--plot", str(chosen.out / PLOTTED[name])] if name in PLOTTED else []
        command = [sys.executable, "-m", "benchmarks", *(["--under-load"] if chosen.under_load else []), benchmark]
        command += [*source, *(["--quick"] if chosen.quick else [*more, *plot])]
        if not chosen.quick or chosen.out != RESULTS:  # quick rows never replace those of the documentation
            command += ["--json", str(chosen.out / f"{name}.json")]
        result[name] = benchmark, command
    return result
