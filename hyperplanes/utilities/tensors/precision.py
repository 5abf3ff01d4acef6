"""Functions that compute in the precision of their inputs, regardless of `torch.autocast`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import ParamSpec, TypeVar

import torch

__all__ = ["without_autocast"]

Given = ParamSpec("Given")
Result = TypeVar("Result")

DEVICES = ("cpu", "cuda")


def without_autocast(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """A function that turns `torch.autocast` off while it runs: rays in bfloat16 miss their pixels.

    Networks that may compute in less say so themselves (`Field.mixed_precision`, `TrainingConfig.precision`).
    """

    @functools.wraps(function)
    def called(*positional: Given.args, **named: Given.kwargs) -> Result:
        with ExitStack() as stack:
            for device in DEVICES:
                if torch.is_autocast_enabled(device):
                    stack.enter_context(torch.autocast(device, enabled=False))
            return function(*positional, **named)

    return called
