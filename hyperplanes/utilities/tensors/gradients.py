"""Functions that take gradient steps, also where their caller has turned gradients off."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

__all__ = ["with_gradients"]

Given = ParamSpec("Given")
Result = TypeVar("Result")


def with_gradients(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """A function that turns gradients on while it runs, within `torch.no_grad`.

    Tensors that are made in `torch.inference_mode` cannot have gradients: there it raises RuntimeError.
    """

    @functools.wraps(function)
    def called(*positional: Given.args, **named: Given.kwargs) -> Result:
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                f"{function.__name__}: expected gradients, got torch.inference_mode; call it outside of that"
            )
        with torch.enable_grad():
            return function(*positional, **named)

    return called
