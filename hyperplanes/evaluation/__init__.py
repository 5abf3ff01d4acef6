"""Evaluation of methods on query views of held-out objects, and comparison of their scores."""

from hyperplanes.evaluation.scores import (
    QUANTITIES,
    ObjectScore,
    Perceptual,
    Score,
    evaluate,
    evaluate_all,
    merge_seeds,
)

__all__ = ["QUANTITIES", "ObjectScore", "Perceptual", "Score", "evaluate", "evaluate_all", "merge_seeds"]
