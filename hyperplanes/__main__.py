"""`python -m hyperplanes` runs the command `hyperplanes`, even if that is not on PATH."""

import sys

from hyperplanes.cli import main

__all__: list[str] = []

if __name__ == "__main__":
    sys.exit(main())
