"""The tables: every method through the same code, on objects and views it never saw."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean, pstdev, stdev
from typing import Any

from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import Adapter, Pictures, Renderable
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.arguments import checked
from hyperplanes.utilities.errors import prefix_errors
from hyperplanes.utilities.metrics import foreground_psnr, pooled_psnr, psnr, ssim
from hyperplanes.utilities.timing import clock
from hyperplanes.views import Task, Tasks

__all__ = ["QUANTITIES", "ObjectScore", "Perceptual", "Score", "evaluate", "evaluate_all", "merge_seeds"]

QUANTITIES = (
    *("psnr", "psnr_pooled", "psnr_foreground", "ssim", "lpips", "adapt_seconds", "render_seconds"),
    "query_views_shown",
)
"""The numbers of an `ObjectScore`, in the order of the tables."""

Perceptual = Callable[[Float[Tensor, "view 3 h w"], Float[Tensor, "view 3 h w"]], Float[Tensor, " view"]]
"""LPIPS, such as `perceptual.LPIPS`: (predicted, truth) -> a distance an image."""


@dataclass(frozen=True)
class ObjectScore:
    """One object by one method.

    Attributes:
        name: of the object.
        psnr: dB, mean over its query views.
        ssim: mean over its query views.
        adapt_seconds: from support views to a field.
        render_seconds: of one query view.
        psnr_pooled: dB, of the squared error of all its query views together.
        psnr_foreground: dB, inside the true masks, mean over its query views; None where no mask has a pixel.
        lpips: mean over its query views; None where its weights were not given.
        query_views_shown: how many of its query views, by their poses, are among the support views; None for none.
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
        """The numbers that there are."""
        return {name: value for name in QUANTITIES if (value := getattr(self, name)) is not None}

    @property
    def image_seconds(self) -> float:
        """From support views to the picture of one query view."""
        return self.adapt_seconds + self.render_seconds


@dataclass(frozen=True)
class Score:
    """A row of the table: means over objects, and the objects themselves.

    Attributes:
        method: the name of the row.
        objects: each a mean over the seeds, where there were several.
        seeds: the rows of the single seeds, where there were several.
    """

    method: str
    objects: tuple[ObjectScore, ...]
    seeds: tuple[Score, ...] = ()

    def mean(self, quantity: str) -> float:
        """Mean of one of `ObjectScore`'s numbers over the objects that have it; NaN where none has."""
        found = self._numbers(quantity)
        return fmean(found) if found else math.nan

    def spread(self, quantity: str) -> float:
        """Standard deviation over the objects that have it."""
        found = self._numbers(quantity)
        return pstdev(found) if found and all(map(math.isfinite, found)) else math.nan

    def _numbers(self, quantity: str) -> list[float]:
        """One of the numbers, of every object that has it."""
        return [value for each in self.objects if (value := getattr(each, quantity)) is not None]

    def deviation(self, quantity: str) -> float | None:
        """Standard deviation over seeds of the mean over objects; None of fewer than two, or of infinite means."""
        means = [seed.mean(quantity) for seed in self.seeds]
        return stdev(means) if len(means) > 1 and all(map(math.isfinite, means)) else None

    @property
    def quantities(self) -> list[str]:
        """The numbers that any object has."""
        return [name for name in QUANTITIES if self._numbers(name)]

    def as_json(self) -> dict[str, Any]:
        """The row as it stands in metrics.json."""
        row: dict[str, Any] = {name: self.mean(name) for name in self.quantities}
        row["objects"] = {each.name: each.as_json() for each in self.objects}
        if self.seeds:
            row["deviation"] = {name: self.deviation(name) for name in self.quantities}
            row["seeds"] = [seed.as_json() for seed in self.seeds]
        return row

    @classmethod
    def of_json(cls, method: str, value: Mapping[str, Any]) -> Score:
        """The row that `as_json` wrote; infinity comes back of null."""

        def score(name: str, numbers: Mapping[str, float | None]) -> ObjectScore:
            return ObjectScore(name, **{key: math.inf if each is None else each for key, each in numbers.items()})

        objects = tuple(score(name, numbers) for name, numbers in value["objects"].items())
        return cls(method, objects, tuple(cls.of_json(method, seed) for seed in value.get("seeds", ())))


def merge_seeds(scores: Sequence[Score]) -> Score:
    """One row of the rows of several seeds: every object's numbers are means over them.

    Args:
        scores: of one method on the same objects in the same order.

    Raises:
        ValueError: none, or other objects.
    """
    if not scores:
        raise ValueError("scores: expected those of at least one seed, got none")
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
    """Adapt to the support views of each object and compare all its query views.

    The method computes where its weights are; pictures are compared where the data is.

    Args:
        method: the name of the row.
        adapter: the method.
        data: where the tasks are.
        names: the objects, never trained on.
        on_object: called after each, with its score, task, pictures and field.
        lpips: where the perceptual distance is asked for, too.
        on_failure: called with an object that cannot be evaluated and the reason, and the next one follows; where
            absent, the first failure ends it.

    Returns:
        The row, of the objects that did not fail.

    Raises:
        ValueError: no object, or one without query views or with views that cannot be used; it is named.
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
    """Every method on every object, by every seed.

    Args:
        methods: by the names of their rows, each a function of the seed.
        data: where the objects are; a sequence has the tasks of each seed, such as other choices of support views.
        names: the objects.
        report: called with (evaluations done, evaluations in all, what has just been found) after each.
        seeds: how many, from 0.
        on_object: called with a method, a seed, a task and its pictures.
        on_score: called with a method, a seed and what has just been measured.
        on_failure: called with a method, a seed, an object that cannot be evaluated and the reason; where absent, the
            first failure ends it.
        lpips: as in `evaluate`.

    Returns:
        The rows in the order of the methods, of the objects that none of them failed on; methods that failed on every
        object have none. Where no object is left for all methods, it is a ValueError, the first failure where
        everything failed.
    """
    done, found, errors = 0, {}, []
    by_seed = data if isinstance(data, Sequence) else [data] * seeds

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
    """The rows of the methods that did not fail on every object, of the objects that none of these failed on."""
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
    """None for NaN, which says that there was nothing to measure."""
    return None if math.isnan(value) else value
