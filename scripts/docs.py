"""The interfaces of all modules as web pages: `python scripts/docs.py FOLDER`."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import pdoc
import pdoc.render

__all__ = ["main"]

PACKAGES = ("hyperplanes", "data_gen")


def main(folder: str) -> None:
    """Write one page a module, and an index."""
    names = []
    for package in PACKAGES:
        found = walk_packages(import_module(package).__path__, f"{package}.")
        names += [package, *(each.name for each in found if not each.name.endswith("worker_process"))]
    for name in names:
        module = import_module(name)
        for public in getattr(module, "__all__", ()):  # pdoc sees only what has been imported
            vars(module)[public] = getattr(module, public)
    warnings.filterwarnings("ignore", message="The module specification")  # packages bring some of their modules
    pdoc.render.configure(docformat="google")
    pdoc.pdoc(*names, output_directory=Path(folder))


if __name__ == "__main__":
    main(sys.argv[1])
