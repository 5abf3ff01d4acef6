"""What is computed from tensors, kept until one of them changes in place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from hyperplanes.utilities.transforms import is_transformed

__all__ = ["kept"]

Made = TypeVar("Made")


def kept(owner: object, name: str, tensors: Sequence[Tensor], make: Callable[[], Made]) -> Made:
    """What is made of some tensors: made once for an object, and anew where they have changed in place.

    Inference tensors do not count their changes, and are taken to have none. Nothing is kept of what a function
    transform makes, and while a graph is compiled what was made before it is taken.

    Args:
        owner: that it is kept with, as `__dict__["_kept_NAME"]`, which its copies and pickles may leave out.
        name: of what is made.
        tensors: that it is made of.
        make: called without arguments.
    """
    found = owner.__dict__.get(f"_kept_{name}")
    if torch.compiler.is_compiling():
        return make() if found is None else found[1]
    if is_transformed(*tensors):
        return make()
    state = [(each.data_ptr(), 0 if each.is_inference() else each._version) for each in tensors]
    if found is None or found[0] != state:
        found = state, make(), list(tensors)  # whose memory is not another's as long as they live
        owner.__dict__[f"_kept_{name}"] = found  # threads that come at once make the same
    return found[1]
