"""`python -m benchmarks NAME [--quick] [--json FILE]`: measure one thing against its reference, in one run."""

import sys
from importlib import import_module

from hyperplanes.utilities.checkpoints import CheckpointError
from hyperplanes.utilities.files import DataError

NAMES = (
    "any_order",
    "busy",
    "captures",
    "generation",
    "hypernetwork",
    "lookup",
    "rendering",
    "training",
    "views",
    "visibility",
)


def main(arguments: list[str]) -> int:
    """Run the benchmark that the first argument names; the exit code is its own, or 2 when there is none.

    Args:
        arguments: the name, and what its `main` reads.
    """
    if not arguments or arguments[0] not in NAMES:
        asked = f"found {arguments[0]!r}" if arguments else "found none"
        wanted = not arguments or arguments[0] not in ("-h", "--help")
        print(f"benchmarks: expected one of {', '.join(NAMES)}, {asked}", file=sys.stderr if wanted else sys.stdout)
        return 2 if wanted else 0
    try:
        return int(import_module(f"benchmarks.{arguments[0]}").main(arguments[1:]) or 0)
    except (DataError, CheckpointError) as error:
        print(f"benchmarks {arguments[0]}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
