"""Scores of methods: all methods are evaluated by the same code, on query views of the same objects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean, stdev
from typing import Any

from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import Adapter, Pictures, Renderable
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.images.metrics import foreground_psnr, pooled_psnr, psnr, ssim
from hyperplanes.utilities.machine.timing import clock
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.messages.errors import prefix_errors
from hyperplanes.views import Task, Tasks

__all__ = ["QUANTITIES", "ObjectScore", "Perceptual", "Score", "evaluate", "evaluate_all", "merge_seeds"]

QUANTITIES = (
    *("psnr", "psnr_pooled", "psnr_foreground", "ssim", "lpips", "adapt_seconds", "render_seconds"),
    "query_views_shown",
)
"""The numbers of an `ObjectScore`, in the order of the tables."""

ALWAYS = ("psnr", "ssim", "adapt_seconds", "render_seconds")
"""Those that every object has."""

Perceptual = Callable[[Float[Tensor, "view 3 h w"], Float[Tensor, "view 3 h w"]], Float[Tensor, " view"]]
"""LPIPS, such as `perceptual.LPIPS`: (predicted, truth) -> one distance per image."""


@dataclass(frozen=True)
class ObjectScore:
    """The score of one method on one object.

    Attributes:
        name: the name of the object.
        psnr: PSNR in dB, mean over its query views.
        ssim: SSIM, mean over its query views.
        adapt_seconds: seconds from support views to a field.
        render_seconds: seconds to render one query view.
        psnr_pooled: PSNR in dB of the mean squared error over all its query views together.
        psnr_foreground: PSNR in dB inside the true masks, mean over its query views; None if no mask has a pixel.
        lpips: LPIPS, mean over its query views; None if no weights were given.
        query_views_shown: the number of query views whose poses are among those of the support views; None for 0.
    """

    name: str
    psnr: float
    ssim: float
    adapt_seconds: float
    render_seconds: float
    psnr_pooled: float | None = None
    psnr_foreground: float | None = None
    lpips: float | None = None
    query_views_shown: float | None = None

    def as_json(self) -> dict[str, float]:
        """The numbers that were measured, by name, without NaN."""
        numbers = {name: getattr(self, name) for name in QUANTITIES}
        return {name: value for name, value in numbers.items() if value is not None and not math.isnan(value)}

    @property
    def image_seconds(self) -> float:
        """Seconds from support views to the picture of one query view."""
        return self.adapt_seconds + self.render_seconds


@dataclass(frozen=True)
class Score:
    """The scores of one method on several objects: a row of the table.

    Attributes:
        method: the name of the row.
        objects: the scores of the objects; if there are several seeds, their means over these.
        seeds: the score of each seed, if there are several.
    """

    method: str
    objects: tuple[ObjectScore, ...]
    seeds: tuple[Score, ...] = ()

    def mean(self, quantity: str) -> float:
        """Mean of a number of `ObjectScore` over the objects that have it; NaN if none has."""
        found = self._numbers(quantity)
        return fmean(found) if found else math.nan

    def spread(self, quantity: str) -> float | None:
        """Standard deviation of a number over the objects that have it; None for fewer than two or infinite numbers."""
        found = self._numbers(quantity)
        return stdev(found) if len(found) > 1 and all(map(math.isfinite, found)) else None

    def _numbers(self, quantity: str) -> list[float]:
        """A number of every object that has it."""
        return [value for each in self.objects if (value := getattr(each, quantity)) is not None]

    def deviation(self, quantity: str) -> float | None:
        """Standard deviation over seeds of the mean over objects; None with fewer than two seeds, or infinite means."""
        means = [seed.mean(quantity) for seed in self.seeds]
        return stdev(means) if len(means) > 1 and all(map(math.isfinite, means)) else None

    @property
    def quantities(self) -> list[str]:
        """The names of the numbers that at least one object has."""
        return [name for name in QUANTITIES if self._numbers(name)]

    def as_json(self) -> dict[str, Any]:
        """The row as a value for JSON, as in metrics.json."""
        row: dict[str, Any] = {name: self.mean(name) for name in self.quantities}
        row["objects"] = {each.name: each.as_json() for each in self.objects}
        if self.seeds:
            row["deviation"] = {name: self.deviation(name) for name in self.quantities}
            row["seeds"] = [seed.as_json() for seed in self.seeds]
        return row

    @classmethod
    def of_json(cls, method: str, value: Mapping[str, Any]) -> Score:
        """The row from the result of `as_json`.

        JSON has neither infinity nor NaN: null is read as infinity, and a missing number that every object has as NaN.
        """

        def score(name: str, numbers: Mapping[str, float | None]) -> ObjectScore:
            known = {key: math.inf if each is None else each for key, each in numbers.items()}
            return ObjectScore(name, **dict.fromkeys(ALWAYS, math.nan) | known)

        objects = tuple(score(name, numbers) for name, numbers in value["objects"].items())
        return cls(method, objects, tuple(cls.of_json(method, seed) for seed in value.get("seeds", ())))


def merge_seeds(scores: Sequence[Score]) -> Score:
    """The score of a method over several seeds: the numbers of every object are means over the seeds.

    Args:
        scores: the scores of one method, one per seed, on the same objects in the same order.

    Raises:
        ValueError: no score, or different objects.
    """
    if not scores:
        raise ValueError("scores: expected the score of at least one seed, got none")
    if len(scores) == 1:
        return scores[0]
    names = [[each.name for each in score.objects] for score in scores]
    if any(each != names[0] for each in names):
        raise ValueError(f"scores: expected the same objects for every seed, got {names}")
    objects = []
    for same in zip(*(score.objects for score in scores), strict=True):
        numbers = {name: [getattr(each, name) for each in same] for name in QUANTITIES}
        objects.append(
            ObjectScore(same[0].name, **{n: fmean(values) for n, values in numbers.items() if None not in values})
        )
    return Score(scores[0].method, tuple(objects), tuple(scores))


@checked
def evaluate(
    method: str,
    adapter: Adapter,
    data: Tasks,
    names: Sequence[str],
    on_object: Callable[[ObjectScore, Task, Pictures, Renderable], None] | None = None,
    lpips: Perceptual | None = None,
    on_failure: Callable[[str, Exception], None] | None = None,
) -> Score:
    """Adapt to the support views of each object, render its query views and compare them with the true images.

    The method computes on the device of its weights; pictures are compared on the device of the data.

    Args:
        method: the name of the row.
        adapter: the method.
        data: the data set.
        names: the objects, on which the method was not trained.
        on_object: called after each object, with its score, task, pictures and field.
        lpips: the perceptual distance, if it is to be measured.
        on_failure: called with the name of an object that cannot be evaluated and the error, after which the next
            object follows. With None, the first error is raised.

    Returns:
        The score on the objects that did not fail.

    Raises:
        ValueError: no object, an object without query views, or views that the method cannot use. The message names the
            object.
        OSError: an object whose files cannot be read.
    """
    if not names:
        raise ValueError("names: expected at least one object to evaluate on, got none")
    scores = []
    for name in names:
        try:
            found = _evaluate_one(name, adapter, data, lpips)
        except (ValueError, OSError) as error:
            if on_failure is None:
                raise
            on_failure(name, error)
            continue
        scores.append(found[0])
        if on_object is not None:
            on_object(*found)
    return Score(method, tuple(scores))


def _evaluate_one(
    name: str, adapter: Adapter, data: Tasks, lpips: Perceptual | None
) -> tuple[ObjectScore, Task, Pictures, Renderable]:
    task = data.task(name)
    if not len(task.query):
        raise ValueError(f"{name}: expected at least one query view to compare with, got none")
    start = clock()
    with prefix_errors(name):
        adapted = adapter.adapt(task.support)
    adapted_at = clock()
    pictures = adapted.render(task.query.cameras)
    rendered_at = clock()
    support, query = (camera.camera_from_world(views.cameras) for views in (task.support, task.query))
    known = (query[:, None] == support).all((-2, -1)).any(1)
    images, truth, masks = pictures.images.to(task.query.images).clamp(0, 1), task.query.images, task.query.masks
    score = ObjectScore(
        name,
        float(psnr(images, truth).mean()),
        float(ssim(images, truth).mean()),
        adapted_at - start,
        (rendered_at - adapted_at) / len(task.query),
        float(pooled_psnr(images, truth)),
        None if masks is None else _number(float(foreground_psnr(images, truth, masks).nanmean())),
        None if lpips is None else float(lpips(images, truth).mean()),
        int(known.sum()) or None,
    )
    return score, task, pictures, adapted


def evaluate_all(
    methods: Mapping[str, Callable[[int], Adapter]],
    data: Tasks | Sequence[Tasks],
    names: Sequence[str],
    report: Callable[[int, int, str], None],
    *,
    seeds: int = 1,
    on_object: Callable[[str, int, Task, Pictures], None] | None = None,
    on_score: Callable[[str, int, ObjectScore], None] | None = None,
    on_failure: Callable[[str, int, str, Exception], None] | None = None,
    lpips: Perceptual | None = None,
) -> list[Score]:
    """Evaluate every method on every object with every seed.

    Args:
        methods: by the names of their rows, functions that make a method from a seed.
        data: the data set; or a sequence of data sets, one per seed, such as with other choices of support views.
        names: the objects.
        report: called after each evaluation with the number of evaluations done, their total, and a line of text.
        seeds: the number of seeds, from 0.
        on_object: called with a method, a seed, a task and its pictures.
        on_score: called with a method, a seed and the score of an object.
        on_failure: called with a method, a seed, an object that cannot be evaluated and the error. With None, the first
            error is raised.
        lpips: as in `evaluate`.

    Returns:
        The scores in the order of the methods, on the objects on which none of these methods failed. Methods that
        failed on every object are left out. If everything failed, the first error is raised.

    Raises:
        ValueError: no common object is left, or another number of data sets than of seeds.
    """
    done, found, errors = 0, {}, []
    by_seed = data if isinstance(data, Sequence) else [data] * seeds
    if len(by_seed) != seeds:
        raise ValueError(f"data: expected a data set for each of {seeds} seeds, got {len(by_seed)}")

    def failed(method: str, seed: int, name: str, error: Exception) -> None:
        nonlocal done
        done += 1
        errors.append(error)
        assert on_failure is not None
        on_failure(method, seed, name, error)

    def seen(method: str, seed: int, score: ObjectScore, task: Task, pictures: Pictures, _: Renderable) -> None:
        nonlocal done
        done += 1
        report(done, len(methods) * len(names) * seeds, f"{method} on {score.name}: {score.psnr:.2f} dB")
        if on_object is not None:
            on_object(method, seed, task, pictures)
        if on_score is not None:
            on_score(method, seed, score)

    for method, make in methods.items():
        runs = []
        for seed in range(seeds):
            look, fail = partial(seen, method, seed), partial(failed, method, seed)
            runs.append(evaluate(method, make(seed), by_seed[seed], names, look, lpips, fail if on_failure else None))
        found[method] = runs
    if len(errors) == done:
        raise errors[0]
    return [merge_seeds(runs) for runs in _of_common_objects(found).values()]


def _of_common_objects(found: Mapping[str, Sequence[Score]]) -> dict[str, list[Score]]:
    """The scores of the methods that did not fail on every object, on the objects on which none of these failed."""
    whole = {method: runs for method, runs in found.items() if all(run.objects for run in runs)}
    done = [{each.name for each in run.objects} for runs in whole.values() for run in runs]
    common = set.intersection(*done) if done else set()
    if not common:
        raise ValueError(
            f"evaluate: expected an object that {', '.join(whole or found)} can all be evaluated on, found none"
        )
    return {
        method: [replace(run, objects=tuple(each for each in run.objects if each.name in common)) for run in runs]
        for method, runs in whole.items()
    }


def _number(value: float) -> float | None:
    """The value, or None for NaN, which means that nothing could be measured."""
    return None if math.isnan(value) else value
