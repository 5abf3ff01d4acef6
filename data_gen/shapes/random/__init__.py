"""Random compositions: training data for a prior of any object."""

from __future__ import annotations

from data_gen.shapes.random.composition import composition

__all__ = ["composition"]
