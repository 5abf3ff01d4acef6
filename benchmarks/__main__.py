"""Run a benchmark: `python -m benchmarks [--under-load] NAME [--quick] [--json FILE]`.

Each benchmark compares an implementation with a reference in the same run. `all` runs all benchmarks, and `tables`
writes the tables of the documentation. A benchmark of speed refuses to write rows while other processes keep more than
`load.LIMIT` cores busy, unless `--under-load` is given. The load is stored with the rows.
"""

import sys
from importlib import import_module

from benchmarks.parts.load import LIMIT, OF_SPEED, load_at_start
from hyperplanes.utilities.messages.errors import one_line, wants_traceback

NAMES = (
    "adapting",
    "all",
    "baked",
    "image_based",
    "busy",
    "captures",
    "correction",
    "gating",
    "generation",
    "gpu",
    "hypernetwork",
    "lookup",
    "rendering",
    "small",
    "splats",
    "steps",
    "tables",
    "training",
    "views",
    "visibility",
)
UNDER_LOAD = "--under-load"


def main(arguments: list[str]) -> int:
    """Run the benchmark that the first argument names.

    Args:
        arguments: the name of the benchmark and its own arguments.

    Returns:
        The exit code of the benchmark; 2 if the name is missing or unknown, the machine is busy, or its input is wrong.

    Raises:
        ValueError: wrong input, if HYPERPLANES_TRACEBACK is set; otherwise one line is printed.
        OSError: likewise.
    """
    whatever = arguments[:1] == [UNDER_LOAD]
    arguments = arguments[whatever:]
    if not arguments or arguments[0] not in NAMES:
        asked = f"found {arguments[0]!r}" if arguments else "found none"
        wanted = not arguments or arguments[0] not in ("-h", "--help")
        print(f"benchmarks: expected one of {', '.join(NAMES)}, {asked}", file=sys.stderr if wanted else sys.stdout)
        return 2 if wanted else 0
    load = load_at_start()
    if arguments[0] in OF_SPEED and _keeps_rows(arguments) and load > LIMIT and not whatever:
        print(
            f"benchmarks {arguments[0]}: expected an idle machine to write rows, found {load:.1f} cores busy; "
            f"wait, or measure anyway: python -m benchmarks {UNDER_LOAD} {arguments[0]}",
            file=sys.stderr,
        )
        return 2
    try:
        return int(import_module(f"benchmarks.{arguments[0]}").main(arguments[1:]) or 0)
    except (ValueError, OSError) as error:  # wrong input, reported as the command line of hyperplanes does
        if wants_traceback():
            raise
        print(f"benchmarks {arguments[0]}: {one_line(error)}", file=sys.stderr)
        return 2


def _keeps_rows(arguments: list[str]) -> bool:
    """Whether --json is given, in any form that argparse accepts: with "=", or abbreviated."""
    names = [word.partition("=")[0] for word in arguments]
    return any(name.startswith("--j") and "--json".startswith(name) for name in names)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
