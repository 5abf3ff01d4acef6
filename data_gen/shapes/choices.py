"""Random choices among options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

__all__ = ["one_of", "pick"]

T = TypeVar("T")


def one_of(rng: np.random.Generator, options: Sequence[T]) -> T:
    """One of the options, all equally probable."""
    return options[int(rng.integers(len(options)))]


def pick(rng: np.random.Generator, shares: Mapping[T, float]) -> T:
    """One of the keys, with probabilities proportional to their shares."""
    weights = np.array(list(shares.values()))
    return list(shares)[int(rng.choice(len(weights), p=weights / weights.sum()))]
