"""A clock that waits for queued GPU work first."""

from __future__ import annotations

import time

import torch

__all__ = ["clock"]


def clock() -> float:
    """The performance counter in seconds, after all queued GPU work is done."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()
