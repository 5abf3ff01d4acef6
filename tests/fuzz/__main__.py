"""Fuzz campaigns of any length: `make fuzz`, or `python -m tests.fuzz --files 10000 --seed 1`.

Wrong command lines and wrong calls are tested by `python -m tests.fuzz --commands 500 --calls 300`.
"""

import argparse
import faulthandler
import shutil
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

import torch

from tests.fuzz.calls import run_calls
from tests.fuzz.campaign import run_campaign
from tests.fuzz.commands import run_commands
from tests.fuzz.corpus import CORPUS


def main():
    """Run the campaigns. Returns the exit code, which is 1 after any failure."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--files", type=int, default=0, help="how many damaged files")
    parser.add_argument("--commands", type=int, default=0, help="how many command lines")
    parser.add_argument("--calls", type=int, default=0, help="how many calls of public functions")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random choices")
    parser.add_argument("--only", type=int, help="the number of a single case")
    parser.add_argument("--kinds", nargs="+", choices=CORPUS, help="kinds of files; by default all")
    options = parser.parse_args()
    faulthandler.enable()
    torch.set_num_threads(1)  # commands run in forks of this process, in which OpenMP would wait for threads
    home = Path(tempfile.mkdtemp(prefix="hyperplanes-fuzz-"))
    campaigns = {
        "files": partial(run_campaign, kinds=options.kinds),
        "commands": run_commands,
        "calls": run_calls,
    }
    found = 0
    for name, run in campaigns.items():
        count = getattr(options, name)
        if not count:
            continue
        (home / name).mkdir()
        started, cases = time.monotonic(), range(count) if options.only is None else [options.only]
        failures = run(cases, options.seed, home / name, report=partial(print, flush=True))
        kinds = ", ".join(f"{count} of {kind}" for kind, count in Counter(each.kind for each in failures).items())
        took = f"{time.monotonic() - started:.0f} s"
        print(f"{len(cases)} {name}, seed {options.seed}, {took}: {len(failures)} failures {kinds}", flush=True)
        found += len(failures)
    if found:
        print(f"the files of the failures are in {home}")
    else:
        shutil.rmtree(home)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
