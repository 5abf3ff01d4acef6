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
        names += [package, *(each.name for each in found if not each.name.endswith("_process"))]
    for name in tuple(names):
        try:
            module = import_module(name)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] in PACKAGES:
                raise
            sys.stderr.write(f"{name}: left out, it needs {error.name}\n")
            names[names.index(name)] = f"!{name}"  # what pdoc is not to import by itself either
            continue
        for public in getattr(module, "__all__", ()):  # pdoc sees only what has been imported
            vars(module)[public] = getattr(module, public)
    warnings.filterwarnings("ignore", message="Couldn't import")  # those that are left out
    warnings.filterwarnings("ignore", message="The module specification")  # packages bring some of their modules
    pdoc.render.configure(docformat="google")
    pdoc.pdoc(*names, output_directory=Path(folder))


if __name__ == "__main__":
    main(sys.argv[1])
