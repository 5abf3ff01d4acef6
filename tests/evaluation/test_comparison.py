"""Sources of truth: SciPy's paired t-test, and arithmetic by hand."""

import math

import numpy as np
import pytest

from hyperplanes.evaluation import ObjectScore, Score, merge_seeds
from hyperplanes.evaluation.comparison import compare, compare_all
from hyperplanes.utilities.files.reading import read_json
from hyperplanes.utilities.files.writing import write_json


def score(method, values, **numbers):
    objects = [ObjectScore(f"o{i}", value, 0.5, 1.0, 2.0, **numbers) for i, value in enumerate(values)]
    return Score(method, tuple(objects))


def test_the_paired_test_is_that_of_scipy():
    from scipy.stats import t, ttest_rel  # imported here, because it takes 0.6 s in each process that collects tests

    first, second = [20.0, 25.5, 31.0, 28.0], [19.0, 25.0, 28.5, 27.9]
    found = compare(score("a", first), score("b", second))
    assert found.p == pytest.approx(ttest_rel(first, second).pvalue)
    differences = np.subtract(first, second)
    half = t.ppf(0.975, 3) * differences.std(ddof=1) / 2  # divided by the square root of four objects
    assert (found.low, found.high) == pytest.approx((differences.mean() - half, differences.mean() + half))
    assert found.differences == pytest.approx({"o0": 1.0, "o1": 0.5, "o2": 2.5, "o3": 0.1})


@pytest.mark.parametrize(("shift", "p"), [(0.0, 1.0), (0.5, 0.0)])
def test_equal_differences_have_an_interval_of_width_zero(shift, p):
    found = compare(score("a", [20.0 + shift, 30.0 + shift]), score("b", [20.0, 30.0]))
    assert (found.low, found.high, found.p) == (shift, shift, p)


def test_one_object_has_no_interval():
    found = compare(score("a", [20.0]), score("b", [19.0]))
    assert (found.mean, found.low, found.p) == (1.0, None, None)


def test_only_the_same_objects_can_be_compared():
    with pytest.raises(ValueError, match="expected the objects of a, o0, o1, got those of b, o0"):
        compare(score("a", [1.0, 2.0]), score("b", [1.0]))
    with pytest.raises(ValueError, match="expected a finite psnr of every object, got none of o1"):
        compare(score("a", [1.0, math.inf]), score("b", [1.0, 2.0]))


def test_pairs_have_the_better_method_first():
    pairs = compare_all([score("low", [10.0, 12.0]), score("high", [20.0, 21.0]), score("perfect", [math.inf, 9.0])])
    assert [(pair.first, pair.second, pair.mean) for pair in pairs] == [("high", "low", 9.5)]


def test_seeds_are_averaged_object_by_object():
    merged = merge_seeds([score("a", [20.0, 30.0]), score("a", [22.0, 34.0], psnr_foreground=1.0)])
    assert [each.psnr for each in merged.objects] == [21.0, 32.0]
    assert merged.objects[0].psnr_foreground is None  # one of the seeds has none
    assert merged.mean("psnr") == 26.5
    assert merged.deviation("psnr") == pytest.approx(3 / 2**0.5)  # the means of the seeds are 25 and 28
    assert merged.spread("psnr") == pytest.approx(11 / 2**0.5)
    assert merge_seeds([score("a", [20.0])]).deviation("psnr") is None
    with pytest.raises(ValueError, match="expected the same objects for every seed"):
        merge_seeds([score("a", [20.0]), score("a", [20.0, 21.0])])


def test_scores_come_back_from_json():
    merged = merge_seeds([score("a", [20.0, 30.0], psnr_pooled=19.0), score("a", [22.0, 34.0], psnr_pooled=21.0)])
    assert Score.of_json("a", merged.as_json()) == merged


def test_numbers_that_are_not_finite_come_back_from_a_file(tmp_path):
    write_json(tmp_path / "score.json", score("a", [math.inf, math.nan, 20.0]).as_json())
    found = Score.of_json("a", read_json(tmp_path / "score.json"))
    assert [each.psnr for each in found.objects] == pytest.approx([math.inf, math.nan, 20.0], nan_ok=True)


def test_the_spread_is_the_sample_standard_deviation():
    assert score("a", [20.0, 22.0]).spread("psnr") == pytest.approx(np.std([20.0, 22.0], ddof=1))
    assert score("a", [20.0]).spread("psnr") is None
    assert score("a", [20.0, math.inf]).spread("psnr") is None
