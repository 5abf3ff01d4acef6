"""Shapes are checked in tests: the package's functions run under jaxtyping and beartype."""

import os
import tempfile

import torch
import typechecker

os.environ["HYPERPLANES_CACHE"] = tempfile.mkdtemp(prefix="hyperplanes-cache-")  # not the user's own
torch.set_num_threads(1)  # small tensors: more threads only wait for each other; tests of threads set their own
typechecker.install("hyperplanes")
