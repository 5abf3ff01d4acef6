"""Scores on objects and views that no method saw, and what sets of scores say of each other."""

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
