"""Sources of truth: a constant error e, whose PSNR is -20 log10 e, and means by hand."""

import json
import math
from dataclasses import dataclass, replace

import pytest
import torch

from hyperplanes.adaptation import NearestView, Pictures
from hyperplanes.data.support import WithSupport
from hyperplanes.evaluation import ObjectScore, Score, evaluate, evaluate_all
from hyperplanes.evaluation.figures import PictureGrid
from hyperplanes.evaluation.suitability import suitability_warnings, worse_than_copying
from hyperplanes.evaluation.tables import rows
from hyperplanes.utilities.images.metrics import foreground_psnr, pooled_psnr, psnr, ssim
from tests.reference_rendering import Balls, awaken, ball_views, ring, small_model


class Shifted:
    """A method that returns the true images with a constant error."""

    def __init__(self, data, error):
        self.data, self.error, self.number = data, error, 0

    def adapt(self, support):
        task = self.data.task(self.data.names("test")[self.number])
        assert torch.equal(support.images, task.support.images)
        self.number += 1
        return Answer(task.query.images, self.error)


@dataclass
class Answer:
    images: torch.Tensor
    error: float

    def render(self, cameras):
        assert cameras.batch_size == len(self.images)
        images = torch.where(self.images + self.error > 1, self.images - self.error, self.images + self.error)
        return Pictures(images, images[:, :1], images[:, :1], 0)


def test_a_constant_error_scores_as_calculated():
    # an error of 0.1 in all values has a PSNR of 20 dB
    data = Balls(test=3)
    score = evaluate("shifted", Shifted(data, 0.1), data, data.names("test"))
    assert [each.name for each in score.objects] == data.names("test")
    assert [each.psnr for each in score.objects] == pytest.approx([20.0] * 3, abs=1e-3)
    assert score.mean("psnr") == pytest.approx(20.0, abs=1e-3)


def test_scores_are_means_over_the_query_views():
    data = Balls(test=1)
    task = data.task("test0")
    score = evaluate("nearest_view", NearestView(), data, ["test0"])
    images = NearestView().adapt(task.support).render(task.query.cameras).images
    assert score.objects[0].psnr == pytest.approx(psnr(images, task.query.images).mean().item())
    assert score.objects[0].ssim == pytest.approx(ssim(images, task.query.images).mean().item())
    assert score.objects[0].psnr_pooled == pytest.approx(pooled_psnr(images, task.query.images).item())
    inside = foreground_psnr(images, task.query.images, task.query.masks).mean().item()
    assert score.objects[0].psnr_foreground == pytest.approx(inside)
    assert score.objects[0].image_seconds == score.objects[0].adapt_seconds + score.objects[0].render_seconds


class Glass(Balls):
    """Objects of which the second has masks with opacity 0.4, which is not foreground."""

    def task(self, name):
        task = super().task(name)
        masks = task.query.masks * (0.4 if name == "test1" else 1.0)
        return replace(task, query=replace(task.query, masks=masks))


def test_an_object_without_foreground_has_no_foreground_psnr():
    data = Glass(test=2)
    score = evaluate("nearest_view", NearestView(), data, ["test0", "test1"])
    assert score.objects[1].psnr_foreground is None
    assert score.mean("psnr_foreground") == score.objects[0].psnr_foreground
    assert "psnr_foreground" in score.quantities
    again = Score.of_json("nearest_view", json.loads(json.dumps(score.as_json())))
    assert again.objects == score.objects


def test_pictures_are_clamped_before_they_are_compared():
    data = Balls(test=1)

    class Overshooting(Shifted):
        def adapt(self, support):
            answer = super().adapt(support)
            answer.images = torch.where(answer.images >= 1, 3.0, answer.images)  # correct after clamping
            answer.error = 0.0
            return answer

    assert evaluate("over", Overshooting(data, 0.0), data, ["test0"]).objects[0].psnr == float("inf")


def test_the_callback_is_called_for_every_object():
    data, seen = Balls(test=2), []
    evaluate("nearest_view", NearestView(), data, data.names("test"), lambda *shown: seen.append(shown))
    assert [score.name for score, _, _, _ in seen] == [task.name for _, task, _, _ in seen] == data.names("test")
    assert all(pictures.images.shape == task.query.images.shape for _, task, pictures, _ in seen)


def test_a_row_in_json():
    score = Score("m", (ObjectScore("a", 20.0, 0.8, 1.0, 0.5), ObjectScore("b", 30.0, 0.6, 3.0, 1.5)))
    assert json.loads(json.dumps(score.as_json())) == {
        "psnr": 25.0,
        "ssim": pytest.approx(0.7),
        "adapt_seconds": 2.0,
        "render_seconds": 1.0,
        "objects": {
            "a": {"psnr": 20.0, "ssim": 0.8, "adapt_seconds": 1.0, "render_seconds": 0.5},
            "b": {"psnr": 30.0, "ssim": 0.6, "adapt_seconds": 3.0, "render_seconds": 1.5},
        },
    }


def test_evaluating_on_no_objects_is_refused():
    with pytest.raises(ValueError, match="names: expected at least one object to evaluate on, got none"):
        evaluate("nearest_view", NearestView(), Balls(), [])


@pytest.mark.parametrize("broken", ["query", "masks"])
def test_an_object_that_cannot_be_evaluated_is_named(broken):
    class Broken(Balls):
        def task(self, name):
            task = super().task(name)
            if broken == "query":
                return replace(task, query=task.query[:0])
            return replace(task, support=replace(task.support, masks=torch.zeros_like(task.support.masks)))

    words = {"query": "test0: expected at least one query view", "masks": "test0: masks of the support views: expected"}
    with pytest.raises(ValueError, match=words[broken]):
        evaluate("hyperplanes", small_model(), Broken(), ["test0"])


def test_pictures_are_compared_in_the_precision_of_the_data():
    data = Balls(test=1)
    score = evaluate("nearest_view", NearestView(), data, ["test0"]).objects[0]

    class Double(Balls):
        def task(self, name):
            task = super().task(name)
            return replace(task, support=task.support, query=task.query.to(dtype=torch.float64))

    assert evaluate("nearest_view", NearestView(), Double(), ["test0"]).objects[0].psnr == pytest.approx(
        score.psnr, abs=1e-4
    )


def test_seeds_of_a_perfect_row_have_no_deviation():
    """A query view that is also a support view is copied, with infinite PSNR for all seeds."""
    seed = Score("nearest_view", (ObjectScore("one", math.inf, 1.0, 0.0, 0.0, math.inf),))
    row = replace(seed, seeds=(seed, seed))
    assert row.deviation("psnr") is None
    assert row.deviation("ssim") == 0
    assert "inf" in headings_and_rows(row)
    assert rows([row])[0][2] == "-", "one object has no deviation over objects"


def test_each_seed_may_have_its_own_tasks():
    data = Balls(test=1, views=6)
    chosen = [WithSupport(data, 2, "random", seed) for seed in range(2)]
    methods = {"nearest_view": lambda seed: NearestView()}
    (row,) = evaluate_all(methods, chosen, ["test0"], lambda *_: None, seeds=2)
    expected = [evaluate("nearest_view", NearestView(), tasks, ["test0"]).mean("psnr") for tasks in chosen]
    assert [run.mean("psnr") for run in row.seeds] == expected
    assert expected[0] != expected[1]
    with pytest.raises(ValueError, match="data: expected a data set for each of 3 seeds, got 2"):
        evaluate_all(methods, chosen, ["test0"], lambda *_: None, seeds=3)


def headings_and_rows(row):
    return " ".join(cell for line in rows([row]) for cell in line)


def test_the_grid_omits_objects_on_which_a_method_failed(tmp_path):
    data, grid = Balls(test=2), PictureGrid()
    one, two = (data.task(name) for name in data.names("test"))
    for method, tasks in (("a", (one, two)), ("b", (two,))):
        for task in tasks:
            grid.add(method, 0, task, Pictures(task.query.images, task.query.masks, task.query.masks, 0))
    grid.save(tmp_path / "grid.svg")
    text = (tmp_path / "grid.svg").read_text()
    assert two.name in text
    assert one.name not in text
    grid.add("c", 0, one, Pictures(one.query.images, one.query.masks, one.query.masks, 0))
    grid.save(tmp_path / "grid.svg")  # there is no object that all three methods have
    text = (tmp_path / "grid.svg").read_text()
    assert one.name in text
    assert two.name in text


def test_checking_the_suitability_of_views_does_not_change_a_model():
    """Only training changes the running statistics of codes."""
    model = awaken(small_model()).train()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    suitability_warnings(model, ball_views(ring(4, (12, 12))))
    assert model.training
    assert any("code_normalisation" in name for name in before)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(("steps", "count", "advised"), [(0, 4, True), (0, 1, False), (5, 4, False), (None, 4, False)])
def test_steps_are_suggested_only_if_they_are_possible(steps, count, advised):
    """`--steps` is refused with a baked file (steps is None) and with a single view."""
    views = ball_views(ring(4, (12, 12)))[:count]
    views = replace(views, masks=torch.zeros(count, 1, 12, 12))
    (line,) = worse_than_copying(views, 10.0, 12.0, steps)
    assert "worse than copying the nearest view: 10.00 dB against 12.00 dB" in line
    assert "`hyperplanes inspect` checks images, masks and poses" in line
    assert ("--steps 100" in line) == advised
    assert worse_than_copying(views, 12.0, 12.0, steps) == []
