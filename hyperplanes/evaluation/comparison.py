"""Two methods on the same objects: paired differences, their interval and a test."""

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
    """How much more of a quantity the first of two methods reaches, over objects.

    Attributes:
        first: a method.
        second: the other.
        quantity: such as "psnr".
        differences: first minus second, by object; means over the seeds where there were several.
        mean: of the differences.
        low: the lower end of the 95 % interval of the mean, by Student's t; None of fewer than two objects.
        high: its upper end.
        p: of the paired t-test, two-sided: how likely such a mean is where the methods do not differ.
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
        """All but the names of methods and quantity."""
        whole = asdict(self)
        return {name: whole[name] for name in ("mean", "low", "high", "p", "differences")}


def compare(first: Score, second: Score, quantity: str = "psnr") -> Comparison:
    """Paired comparison of two methods over the objects of both.

    The objects of a class are the sample; what is concluded holds for other objects of it, for these trainings.

    Args:
        first: one row.
        second: another, of the same objects.
        quantity: one of `evaluation.QUANTITIES`.

    Raises:
        ValueError: other objects, or a quantity that is missing or not finite for one.
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
    """Every pair of methods whose PSNR is finite on every object, the better one first, largest difference first."""
    whole = [score for score in scores if math.isfinite(score.mean("psnr"))]
    ordered = sorted(whole, key=lambda score: -score.mean("psnr"))
    pairs = [compare(first, second) for first, second in combinations(ordered, 2)]
    return sorted(pairs, key=lambda pair: -pair.mean)


def _interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """The ends of the interval and p; differences that are all alike leave no doubt."""
    from scipy.stats import ttest_1samp

    if len(values) < 2:
        return None, None, None
    if max(values) - min(values) <= 1e-12 * max(map(abs, values)):
        return values[0], values[0], 1.0 if values[0] == 0 else 0.0
    found = ttest_1samp(values, 0.0)
    low, high = found.confidence_interval(CONFIDENCE)
    return float(low), float(high), float(tuple(found)[1])
