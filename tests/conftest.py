"""Shapes are checked in tests: the package's functions run under jaxtyping and beartype."""

import torch
import typechecker

torch.set_num_threads(1)  # small tensors: more threads only wait for each other; tests of threads set their own
typechecker.install("hyperplanes")
