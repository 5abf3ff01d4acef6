"""Shapes are checked in tests: the package's functions run under jaxtyping and beartype."""

from jaxtyping import install_import_hook

install_import_hook("hyperplanes", "typechecker.check")
