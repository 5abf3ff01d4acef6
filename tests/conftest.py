"""Shapes are checked in tests: the package's functions run under jaxtyping and beartype."""

import torch
from jaxtyping import install_import_hook

torch.set_num_threads(1)  # small tensors: more threads only wait for each other; tests of threads set their own
install_import_hook("hyperplanes", "typechecker.check")
