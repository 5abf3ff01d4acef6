"""Which process of a training this is, by the variables of torchrun and Fabric, without importing torch."""

from __future__ import annotations

import os

__all__ = ["is_first_process"]

RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK")
"""Environment variables; in the first process, all that are set are 0."""


def is_first_process(asked: int) -> bool:
    """Whether this process is the one of a training that writes and reports.

    Args:
        asked: number of processes asked for; a single one is the first, whatever is set, unless torchrun started it.
    """
    if asked == 1 and "TORCHELASTIC_RUN_ID" not in os.environ:
        return True
    return all(os.environ.get(name, "0") in ("", "0") for name in RANKS)
