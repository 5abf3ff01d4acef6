"""Values computed from tensors, cached until one of them changes in place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from hyperplanes.utilities.tensors.transforms import is_transformed

__all__ = ["cached_on"]

Made = TypeVar("Made")


def cached_on(owner: object, name: str, tensors: Sequence[Tensor], make: Callable[[], Made]) -> Made:
    """A value computed from tensors, cached on an object and recomputed when one of them has changed in place.

    Inference tensors, which have no version counter, are assumed not to change. Nothing is cached under function
    transforms; during graph compilation an existing value is used.

    Args:
        owner: the object, which stores it as `__dict__["_cached_NAME"]`; copies and pickles may leave that out.
        name: name of the value.
        tensors: what it is computed from.
        make: computes it, without arguments.
    """
    found = owner.__dict__.get(f"_cached_{name}")
    if torch.compiler.is_compiling():
        return make() if found is None else found[1]
    if is_transformed(*tensors):
        return make()
    state = [(each.data_ptr(), 0 if each.is_inference() else each._version) for each in tensors]
    if found is None or found[0] != state:
        found = state, make(), list(tensors)  # kept alive, so that no other tensor gets their memory
        owner.__dict__[f"_cached_{name}"] = found  # concurrent threads compute the same
    return found[1]
