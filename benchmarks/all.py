"""Every benchmark that needs no data of yours, one after the other, with its rows and figures in benchmarks/results.

    python -m benchmarks all

Each runs in a process of its own, and writes the commit, the hardware and the load beside its rows.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

__all__ = ["main"]

RESULTS = Path(__file__).parent / "results"
COMMANDS: dict[str, list[str]] = {
    "lookup": ["--plot", "lookup.png"],
    "visibility": [],
    "busy": [],
    "rendering": ["--sizes", "64", "128", "200", "400"],
    "small": ["--second-pass"],
    "splats": [],
    "training": [],
    "generation": [],
}
"""Options of each beside --json; names of pictures are those of files in the folder of results."""


def main(arguments: list[str]) -> int:
    """Run all, and say which failed.

    Args:
        arguments: see --help.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks all", description=__doc__)
    parser.add_argument("--out", type=Path, default=RESULTS, help="the folder of the results (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="the short way of each: to see that they run")
    parser.add_argument("--under-load", action="store_true", help="measure beside other work, too")
    chosen = parser.parse_args(arguments)
    failed = []
    for name, options in COMMANDS.items():
        options = [str(chosen.out / each) if each.endswith(".png") else each for each in options]
        command = [sys.executable, "-m", "benchmarks", *(["--under-load"] if chosen.under_load else []), name]
        command += ["--quick"] if chosen.quick else options
        command += ["--json", str(chosen.out / f"{name}.json")]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
    print(f"benchmarks all: {len(COMMANDS) - len(failed)} of {len(COMMANDS)} done", *failed, sep="; failed: ")
    return 1 if failed else 0
