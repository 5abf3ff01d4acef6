"""Comparison of two methods on the same objects: paired differences, their confidence interval and a t-test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from statistics import fmean
from typing import Any

from hyperplanes.evaluation.scores import Score

__all__ = ["Comparison", "compare", "compare_all"]

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Comparison:
    """The differences of a quantity between two methods, over objects.

    Attributes:
        first: the name of a method.
        second: the name of another method.
        quantity: the name of the quantity, such as "psnr".
        differences: first minus second, by object; if there are several seeds, of the means over them.
        mean: the mean of the differences.
        low: the lower end of the 95 % confidence interval of the mean, by Student's t; None with fewer than two
            objects.
        high: the upper end of the interval; None with fewer than two objects.
        p: the p-value of the two-sided paired t-test: the probability of a mean at least this far from 0 if the methods
            do not differ. None with fewer than two objects.
    """

    first: str
    second: str
    quantity: str
    differences: dict[str, float]
    mean: float
    low: float | None
    high: float | None
    p: float | None

    def as_json(self) -> dict[str, Any]:
        """All attributes but the names of the methods and of the quantity, as values for JSON."""
        whole = asdict(self)
        return {name: whole[name] for name in ("mean", "low", "high", "p", "differences")}


def compare(first: Score, second: Score, quantity: str = "psnr") -> Comparison:
    """Paired comparison of two methods over the same objects.

    The objects are a sample of their class. So the result holds for other objects of the class, with these trained
    models.

    Args:
        first: the score of a method.
        second: the score of another method, on the same objects.
        quantity: one of `evaluation.QUANTITIES`.

    Raises:
        ValueError: different objects, or a quantity that is missing or not finite for an object.
    """
    ours = {each.name: getattr(each, quantity) for each in first.objects}
    theirs = {each.name: getattr(each, quantity) for each in second.objects}
    if ours.keys() != theirs.keys():
        raise ValueError(
            f"compare: expected the objects of {first.method}, {', '.join(ours)}, got those of {second.method}, "
            f"{', '.join(theirs)}"
        )
    if bad := [name for name in ours for each in (ours, theirs) if each[name] is None or not math.isfinite(each[name])]:
        raise ValueError(f"compare: expected a finite {quantity} of every object, got none of {bad[0]}")
    differences = {name: ours[name] - theirs[name] for name in ours}
    low, high, p = _interval(list(differences.values()))
    return Comparison(first.method, second.method, quantity, differences, fmean(differences.values()), low, high, p)


def compare_all(scores: Sequence[Score]) -> list[Comparison]:
    """Compares all pairs of methods by PSNR, the better one first, in descending order of the difference.

    Methods with an infinite PSNR or NaN on some object are left out.
    """
    whole = [score for score in scores if math.isfinite(score.mean("psnr"))]
    ordered = sorted(whole, key=lambda score: -score.mean("psnr"))
    pairs = [compare(first, second) for first, second in combinations(ordered, 2)]
    return sorted(pairs, key=lambda pair: -pair.mean)


def _interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """The ends of the interval, and p; None with fewer than two values. Equal values have an interval of length 0."""
    from scipy.stats import ttest_1samp

    if len(values) < 2:
        return None, None, None
    if max(values) - min(values) <= 1e-12 * max(map(abs, values)):
        return values[0], values[0], 1.0 if values[0] == 0 else 0.0
    found = ttest_1samp(values, 0.0)
    low, high = found.confidence_interval(CONFIDENCE)
    return float(low), float(high), float(tuple(found)[1])
