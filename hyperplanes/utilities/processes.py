"""Which process of a training this is, told without importing torch: by what torchrun and Fabric set for each."""

from __future__ import annotations

import os

__all__ = ["is_first_process"]

RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK")
"""Environment variables; all that are set are 0 in the first process."""


def is_first_process() -> bool:
    """Whether this process is the one of a training that writes and reports; true of a process on its own."""
    return all(os.environ.get(name, "0") in ("", "0") for name in RANKS)
