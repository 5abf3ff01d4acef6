"""OpenMP threads that sleep instead of spinning while they wait."""

from __future__ import annotations

import os
import sys

__all__ = ["wait_passively"]

DECIDED_BY = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def wait_passively() -> None:
    """Let the threads of PyTorch's OpenMP sleep while they wait, unless the environment says how they wait.

    By default they spin: with other processes on the same cores, a spinning thread keeps the one it waits for from
    running, and two threads take up to ten times as long as one (`python -m benchmarks busy`). On an idle machine
    spinning is some 15 % faster. OpenMP reads the variable when PyTorch is loaded, so call this before; child processes
    inherit it. Nothing changes where OMP_WAIT_POLICY, GOMP_SPINCOUNT or KMP_BLOCKTIME is
    set, or PyTorch is loaded.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in DECIDED_BY):
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
