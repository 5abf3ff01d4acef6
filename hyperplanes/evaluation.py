"""The tables: every method through the same code, on objects and views it never saw."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from hyperplanes.adaptation.base import Adapter, Pictures
from hyperplanes.errors import prefix_errors
from hyperplanes.metrics import psnr, ssim
from hyperplanes.views import Task, Tasks

__all__ = ["ObjectScore", "Score", "evaluate", "evaluate_all"]


@dataclass(frozen=True)
class ObjectScore:
    """One object by one method.

    Attributes:
        name: of the object.
        psnr: dB, mean over its query views.
        ssim: mean over its query views.
        adapt_seconds: from support views to a field.
        render_seconds: of one query view.
    """

    name: str
    psnr: float
    ssim: float
    adapt_seconds: float
    render_seconds: float


@dataclass(frozen=True)
class Score:
    """A row of the table: means over objects, and the objects themselves."""

    method: str
    objects: tuple[ObjectScore, ...]

    def mean(self, quantity: str) -> float:
        """Mean over objects of one of `ObjectScore`'s numbers."""
        return fmean(getattr(each, quantity) for each in self.objects)

    def as_json(self) -> dict[str, object]:
        """The row as it stands in metrics.json."""
        names = ("psnr", "ssim", "adapt_seconds", "render_seconds")
        return {
            **{name: self.mean(name) for name in names},
            "objects": {each.name: {name: getattr(each, name) for name in names} for each in self.objects},
        }


def evaluate(
    method: str,
    adapter: Adapter,
    data: Tasks,
    names: Sequence[str],
    on_object: Callable[[ObjectScore, Task, Pictures], None] | None = None,
) -> Score:
    """Adapt to the support views of each object and compare all its query views.

    The method computes where its weights are; pictures are compared where the data is.

    Args:
        method: the name of the row.
        adapter: the method.
        data: where the tasks are.
        names: the objects, never trained on.
        on_object: called after each, with its score, task and pictures.

    Returns:
        The row.

    Raises:
        ValueError: no object, or one without query views or with views that cannot be used; it is named.
    """
    if not names:
        raise ValueError("names: expected at least one object to evaluate on, got none")
    scores = []
    for name in names:
        task = data.task(name)
        if not len(task.query):
            raise ValueError(f"{name}: expected at least one query view to compare with, got none")
        start = time.perf_counter()
        with prefix_errors(name):
            adapted = adapter.adapt(task.support)
        adapted_at = time.perf_counter()
        pictures = adapted.render(task.query.cameras)
        rendered_at = time.perf_counter()
        images = pictures.images.to(task.query.images).clamp(0, 1)
        score = ObjectScore(
            name,
            float(psnr(images, task.query.images).mean()),
            float(ssim(images, task.query.images).mean()),
            adapted_at - start,
            (rendered_at - adapted_at) / len(task.query),
        )
        scores.append(score)
        if on_object is not None:
            on_object(score, task, pictures)
    return Score(method, tuple(scores))


def evaluate_all(
    methods: Mapping[str, Adapter],
    data: Tasks,
    names: Sequence[str],
    report: Callable[[int, int, str], None],
) -> list[Score]:
    """Every method on every object.

    Args:
        methods: by the names of their rows.
        data: where the objects are.
        names: the objects.
        report: called with (evaluations done, evaluations in all, what has just been found) after each.

    Returns:
        The rows in the order of the methods.
    """
    done, scores = 0, []

    def count(method: str, score: ObjectScore) -> None:
        nonlocal done
        done += 1
        report(done, len(methods) * len(names), f"{method} on {score.name}: {score.psnr:.2f} dB")

    for method, adapter in methods.items():
        scores.append(evaluate(method, adapter, data, names, lambda score, *_, method=method: count(method, score)))
    return scores
