"""Weight initialisation determined by a seed alone."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

import torch

from hyperplanes.utilities.machine.locks import ForkSafeLock

__all__ = ["seeded"]

_alone = ForkSafeLock()


@contextmanager
def seeded(seed: int) -> Generator[None]:
    """Seed PyTorch's global CPU generator, from which modules draw initial weights; restore its state afterwards.

    Threads enter this one after the other.
    """
    with _alone, torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)  # `torch.manual_seed` would seed GPUs, too
        yield
