"""Every benchmark, one after the other: rows and figures in benchmarks/results, and the tables of the pages.

    python -m benchmarks all
    python -m benchmarks all --data data/cars data/chairs

Each runs in a process of its own, and writes the commit, the hardware and the load beside its rows. Those that judge or
train models need data sets, and are left out without --data.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from benchmarks import tables

__all__ = ["COMMANDS", "OF_DATA", "main"]

RESULTS = Path(__file__).parent / "results"
COMMANDS: dict[str, list[str]] = {
    "adapting": [],
    "lookup": ["--plot", "lookup.png"],
    "visibility": [],
    "busy": [],
    "rendering": ["--sizes", "64", "128", "200", "400", "--plot", "rendering.png"],
    "small": [],
    "splats": [],
    "steps": [],
    "training": [],
    "training_curves": ["--curves", "120", "--plot", "training_curves.png"],
    "generation": [],
    "captures": ["--checkpoint", "small"],
}
"""Names of results, and options of the benchmarks beside --json; pictures lie in the folder of results."""

OF_DATA = ("views", "baked", "image_based", "hypernetwork")
"""Those that are given --data, and no other option."""


def main(arguments: list[str]) -> int:
    """Run all, and say which failed.

    Args:
        arguments: see --help.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks all", description=__doc__)
    parser.add_argument("--out", type=Path, default=RESULTS, help="the folder of the results (default: %(default)s)")
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="data sets for " + ", ".join(OF_DATA))
    parser.add_argument("--quick", action="store_true", help="the short way of each: to see that they run")
    parser.add_argument("--under-load", action="store_true", help="measure beside other work, too")
    chosen = parser.parse_args(arguments)
    data = ["--data", *map(str, chosen.data)]
    commands = COMMANDS | (dict.fromkeys(OF_DATA, data) if chosen.data else {})
    failed = []
    for name, options in commands.items():
        options = [str(chosen.out / each) if each.endswith(".png") else each for each in options]
        benchmark = name.removesuffix("_curves")
        command = [sys.executable, "-m", "benchmarks", *(["--under-load"] if chosen.under_load else []), benchmark]
        command += [*(data if name in OF_DATA else []), "--quick"] if chosen.quick else options
        command += ["--json", str(chosen.out / f"{name}.json")]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
    print(f"benchmarks all: {len(commands) - len(failed)} of {len(commands)} done", *failed, sep="; failed: ")
    if not chosen.data:
        print(f"benchmarks all: without --data none of {', '.join(OF_DATA)}")
    if chosen.out == RESULTS and not chosen.quick:
        tables.main([])
    return 1 if failed else 0
