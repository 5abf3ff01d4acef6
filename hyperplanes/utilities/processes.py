"""Which process of a training this is, told without importing torch: by what torchrun and Fabric set for each."""

from __future__ import annotations

import os

__all__ = ["is_first_process"]

RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK")
"""Environment variables; all that are set are 0 in the first process."""


def is_first_process(asked: int) -> bool:
    """Whether this process is the one of a training that writes and reports.

    Args:
        asked: how many processes the command asks for; one alone is the first whatever else is set, but by torchrun.
    """
    if asked == 1 and "TORCHELASTIC_RUN_ID" not in os.environ:
        return True
    return all(os.environ.get(name, "0") in ("", "0") for name in RANKS)
