"""The results of an experiment beside the paper's numbers, as Markdown, CSV and JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from statistics import fmean, stdev
from typing import Any

from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.evaluation import Score
from hyperplanes.experiments.configurations import DIFFERENCE_HEADINGS, differences
from hyperplanes.experiments.engine import Outcome
from hyperplanes.experiments.paper.experiment import Cell
from hyperplanes.experiments.paper.published import SOURCES
from hyperplanes.utilities.files.tables import csv_table, markdown_table
from hyperplanes.utilities.machine.environment import environment

__all__ = ["as_csv", "as_json", "as_markdown", "headings", "rows", "settings", "sources", "value", "what_differs"]

SILENT = ("MultiPlaneNeRF", "PointMultiPlaneNeRF", "Autoencoder")
"""Rows and columns of models whose settings the paper and its code do not state."""

DECIMALS = {"psnr": 2, "psnr_pooled": 2, "ssim": 3, "image_seconds": 2}


def value(score: Score, quantity: str) -> tuple[float, float | None]:
    """A number of the table and its standard deviation: over seeds, if there are several; for seconds, over objects."""
    if quantity == "image_seconds":
        seconds = [each.image_seconds for each in score.objects]
        return fmean(seconds), stdev(seconds) if len(seconds) > 1 else None
    return score.mean(quantity), score.deviation(quantity)


def headings(outcome: Outcome) -> list[str]:
    """The headings of `rows`: for every column its result, its pooled PSNR if there is one, and the paper's number."""
    found = [""]
    for column in outcome.experiment.columns:
        found.append(column)
        if _pooled_column(outcome, column):
            found.append("pooled")
        if _published_column(outcome, column):
            found.append("paper")
    return found


def rows(outcome: Outcome) -> list[list[str]]:
    """The rows of the table as text."""
    experiment = outcome.experiment
    cells = {(cell.row, cell.column): cell for cell in experiment.cells}
    table = []
    for row in experiment.rows:
        line = [row]
        for column in experiment.columns:
            cell = cells.get((row, column))
            line.append("-" if cell is None else _ours(outcome, cell))
            if _pooled_column(outcome, column):
                pooled = cell is not None and cell.quantity == "psnr"
                line.append(_ours(outcome, replace(cell, quantity="psnr_pooled")) if cell and pooled else "-")
            if _published_column(outcome, column):
                line.append(_theirs(outcome, row, column))
        table.append(line)
    return table


def _pooled_column(outcome: Outcome, column: str) -> bool:
    return any(cell.column == column and cell.quantity == "psnr" for cell in outcome.experiment.cells)


def _published_column(outcome: Outcome, column: str) -> bool:
    published = outcome.experiment.published
    return published is not None and column in published.columns


def _shown(number: float, deviation: float | None, decimals: int) -> str:
    spread = "" if deviation is None else f" ± {deviation:.{decimals}f}"
    return f"{number:.{decimals}f}{spread}"


def _ours(outcome: Outcome, cell: Cell) -> str:
    return _shown(*value(outcome.scores[cell.row, cell.column], cell.quantity), DECIMALS[cell.quantity])


def _theirs(outcome: Outcome, row: str, column: str) -> str:
    number = outcome.experiment.published_value(row, column)
    if number is None:
        return "-"
    return _shown(number, outcome.experiment.published_deviation(row, column), 3 if row == "SSIM" else 2)


def what_differs(outcome: Outcome) -> list[str]:
    """Lines on the differences from the paper, and on what the paper does not state."""
    experiment, scale = outcome.experiment, outcome.scale
    lines = [f"Data: {_data(outcome)}. Paper: ShapeNet at {experiment.size}x{experiment.size}, 25 and 25 views."]
    if scale.steps is not None and (steps := _steps(outcome, scale.steps)):
        epochs = experiment.epochs
        paper = epochs if isinstance(epochs, int) else ", ".join(f"{n}s {count}" for n, count in epochs.items())
        lines.append(f"Training: {steps}. Paper: epochs, {paper}.")
    if scale.max_steps is not None and any(scale.method(cell.method) != cell.method for cell in experiment.cells):
        lines.append(f"At most {scale.max_steps} gradient steps on the support views of an object.")
    if experiment.figure == "steps" and scale.max_curve_steps is not None:
        lines.append(f"At most {scale.max_curve_steps:,} gradient steps on the support views of an object.")
    if scale.evaluated is not None and experiment.objects is None:
        counts = sorted({len(score.objects) for score in outcome.scores.values()})
        count = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
        lines.append(f"Evaluated on {count} object{'' if count == '1' else 's'} a class. Paper: all test objects.")
    lines.append(f"{_seeds(outcome)}. Paper: {experiment.runs or 'not stated'}.")
    silent = [
        name for name in SILENT if any(cell.column == name or cell.row.endswith(name) for cell in experiment.cells)
    ]
    if silent:
        lines.append(f"No source states settings of {', '.join(silent)}; those of the target of HyperPlanes are used.")
    return [*lines, *experiment.notes]


def _data(outcome: Outcome) -> str:
    """The data sets, and the number of training objects."""
    scale, parts = outcome.scale, []
    if len(outcome.given) < len(outcome.experiment.classes):
        size, views = f"{scale.resolution}x{scale.resolution}", scale.views // 2
        parts.append(f"procedural objects of {size} pixels, {views} support and {views} query views")
    if outcome.given:
        parts.append(f"given data sets of {', '.join(f'{name}s' for name in outcome.given)}")
    if outcome.objects:
        parts.append("trained on " + ", ".join(f"{count} {name}s" for name, count in outcome.objects.items()))
    return "; ".join(parts)


def _steps(outcome: Outcome, steps: int) -> str:
    """The number of steps of each training; empty if all models are packaged."""
    trained = [each.method in LEARNED for each in outcome.experiment.trainings if not each.packaged]
    learned = outcome.scale.learned.get("training.steps", steps)
    parts = [] if all(trained) else [f"{steps:,} steps of each model"]
    if any(trained) and (learned != steps or not parts):
        parts.append(f"{learned:,} {'' if parts else 'steps '}of learned initialisations")
    return ", ".join(parts)


def _seeds(outcome: Outcome) -> str:
    """The number of seeds and their use."""
    packaged = [cell for cell in outcome.experiment.cells if cell.trained.packaged]
    if len(packaged) == len(outcome.experiment.cells):
        return "Seeds: packaged models are evaluated once"
    spread = "; ± is the standard deviation over them" if outcome.seeds > 1 else ""
    once = "; packaged models are evaluated once" if packaged and outcome.seeds > 1 else ""
    return f"Seeds: {outcome.seeds}, each that of a training and of the fine-tuning of its evaluations{spread}{once}"


def _evaluated(score: Score) -> int:
    """The number of seeds of a score."""
    return max(1, len(score.seeds))


def settings(outcome: Outcome) -> list[list[str]]:
    """The settings for which a source states another value, one row each, under `DIFFERENCE_HEADINGS`."""
    return [each.row for each in differences(outcome.experiment, outcome.scale)]


def sources() -> list[str]:
    """The sources of the columns of `settings`, one line each."""
    return [f"{source.name}: {source.where}" for source in SOURCES]


def as_markdown(outcome: Outcome, command: str, figures: Sequence[str] = ("figure.png",)) -> str:
    """The page of an experiment: its table, figures, differences from the paper, command and machine.

    Args:
        outcome: the results.
        command: the command that reproduces them.
        figures: the names of the figures in the same folder.
    """
    experiment, where = outcome.experiment, environment()
    machine = f"{where['gpu'] or where['processor']}, {where['cores']} cores, torch {where['torch']}"
    notes = "\n".join(f"- {line}" for line in what_differs(outcome))
    shown = "\n\n".join(f"![{name.partition('.')[0]}]({name})" for name in figures)
    columns, differing = "\n".join(f"- {line}" for line in sources()), ""
    if stated := settings(outcome):
        differing = (
            f"Settings for which a source states another value (preset {outcome.scale.presets[experiment.size]}); - if "
            f"it states none:\n\n{markdown_table(DIFFERENCE_HEADINGS, stated)}\n{columns}\n\n"
        )
    return (
        f"# {experiment.title}\n\nHyperPlanes (arXiv 2402.01524), {experiment.where}.\n\n"
        f"{markdown_table(headings(outcome), rows(outcome))}\n"
        f"{shown}\n\n## What differs\n\n{notes}\n\n"
        f"{differing}## How it was made\n\n"
        f"    {command}\n\nCommit {where['commit']}; {machine}.\n"
    )


def as_csv(outcome: Outcome) -> str:
    """One line per number, with the paper's number, in full precision."""
    lines: list[Sequence[object]] = []
    for cell in outcome.experiment.cells:
        score = outcome.scores[cell.row, cell.column]
        number, deviation = value(score, cell.quantity)
        pooled = score.mean("psnr_pooled") if cell.quantity == "psnr" else None
        theirs = outcome.experiment.published_value(cell.row, cell.column)
        lines.append((cell.row, cell.column, cell.quantity, number, deviation, pooled, _evaluated(score), theirs))
    return csv_table(("row", "column", "quantity", "value", "deviation", "pooled", "seeds", "paper"), lines)


def as_json(outcome: Outcome, command: str) -> dict[str, Any]:
    """All results, including those of single objects and seeds, as values for JSON."""
    found: dict[str, Any] = {}
    for cell in outcome.experiment.cells:
        score = outcome.scores[cell.row, cell.column]
        number, deviation = value(score, cell.quantity)
        found.setdefault(cell.row, {})[cell.column] = {
            "quantity": cell.quantity,
            "value": number if math.isfinite(number) else None,
            "deviation": deviation,
            "paper": outcome.experiment.published_value(cell.row, cell.column),
            "score": score.as_json(),
        }
    return {
        "experiment": outcome.experiment.name,
        "where": outcome.experiment.where,
        "scale": outcome.scale.name,
        "seeds": max(map(_evaluated, outcome.scores.values())),
        "command": command,
        "differs": what_differs(outcome),
        "settings": [asdict(each) for each in differences(outcome.experiment, outcome.scale)],
        **environment(),
        "table": found,
        "curves": outcome.curves,
    }
