"""The fuzz campaign at any length: `make fuzz`, or `python -m tests.fuzz --files 10000 --seed 1`."""

import argparse
import faulthandler
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.campaign import run_campaign
from tests.fuzz.corpus import CORPUS


def main():
    """Run it; the exit code is 1 where a file was neither read nor refused in one line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--files", type=int, default=10_000, help="how many damaged files")
    parser.add_argument("--seed", type=int, default=0, help="of all damages")
    parser.add_argument("--only", type=int, help="the number of a single case")
    parser.add_argument("--kinds", nargs="+", choices=CORPUS, help="of files; all when not given")
    options = parser.parse_args()
    faulthandler.enable()
    cases = range(options.files) if options.only is None else [options.only]
    started, home = time.monotonic(), Path(tempfile.mkdtemp(prefix="hyperplanes-fuzz-"))
    failures = run_campaign(cases, options.seed, home, options.kinds)
    for failure in failures:
        print(failure)
    kinds = ", ".join(f"{count} of {kind}" for kind, count in Counter(each.kind for each in failures).items())
    print(
        f"{len(cases)} files, seed {options.seed}, {time.monotonic() - started:.0f} s: {len(failures)} failures {kinds}"
    )
    if failures:
        print(f"the damaged files are in {home}")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
