"""Tables of the scores of several methods, as text, CSV, Markdown and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hyperplanes.evaluation.comparison import Comparison
from hyperplanes.evaluation.scores import QUANTITIES, Score
from hyperplanes.utilities.files.tables import csv_table, markdown_table
from hyperplanes.utilities.messages.formatting import format_duration

__all__ = ["PAIR_HEADINGS", "as_csv", "as_json", "as_markdown", "compared_rows", "headings", "rows"]

PAIR_HEADINGS = ("paired over objects, PSNR", "difference", "95 % interval", "p")
"""The headings of `compared_rows`."""

METRIC_LABELS = {
    "psnr": "PSNR",
    "psnr_foreground": "inside mask",
    "psnr_pooled": "pooled",
    "ssim": "SSIM",
    "lpips": "LPIPS",
}


def headings(scores: Sequence[Score]) -> list[str]:
    """The headings of `rows`, for the numbers that every method has."""
    found = ["method", "PSNR", "over objects"]
    found += [label for name, label in METRIC_LABELS.items() if name != "psnr" and _all_have(scores, name)]
    return [*found, "to adapt", "to render a view"]


def rows(scores: Sequence[Score]) -> list[tuple[str, ...]]:
    """The rows of the table as text, one per method.

    ± is the standard deviation over seeds; "over objects" is that over objects.
    """
    table = []
    for score in scores:
        spread = score.spread("psnr")
        row = [score.method, _shown(score, "psnr"), "-" if spread is None else f"± {spread:.2f} dB"]
        row += [_shown(score, name) for name in METRIC_LABELS if name != "psnr" and _all_have(scores, name)]
        row += [format_duration(score.mean(name)) for name in ("adapt_seconds", "render_seconds")]
        table.append(tuple(row))
    return table


def _all_have(scores: Sequence[Score], quantity: str) -> bool:
    return all(quantity in score.quantities for score in scores)


def _shown(score: Score, quantity: str) -> str:
    decimals, unit = (2, " dB") if quantity.startswith("psnr") else (3, "")
    deviation = score.deviation(quantity)
    spread = "" if deviation is None else f" ± {deviation:.{decimals}f}"
    return f"{score.mean(quantity):.{decimals}f}{spread}{unit}"


def compared_rows(pairs: Sequence[Comparison]) -> list[tuple[str, ...]]:
    """The rows of the table of pairs of methods as text, under PAIR_HEADINGS."""
    return [
        (
            f"{pair.first} - {pair.second}",
            f"{pair.mean:+.2f} dB",
            "-" if pair.low is None or pair.high is None else f"{pair.low:+.2f} to {pair.high:+.2f}",
            "-" if pair.p is None else f"{pair.p:.2g}",
        )
        for pair in pairs
    ]


def as_json(scores: Sequence[Score], pairs: Sequence[Comparison]) -> Mapping[str, object]:
    """The content of the file of `--json`: numbers by method, with "differences" to the methods that are worse."""
    table = {score.method: score.as_json() for score in scores}
    for pair in pairs:
        table[pair.first].setdefault("differences", {})[pair.second] = pair.as_json()
    return table


def as_csv(scores: Sequence[Score]) -> str:
    """One line per method, seed and object, with every number that was measured."""
    lines = [
        (score.method, seed, each.name, *(getattr(each, name) for name in QUANTITIES))
        for score in scores
        for seed, run in enumerate(score.seeds or (score,))
        for each in run.objects
    ]
    return csv_table(("method", "seed", "object", *QUANTITIES), lines)


def as_markdown(scores: Sequence[Score], pairs: Sequence[Comparison], about: str) -> str:
    """The tables of methods and of their pairs.

    Args:
        scores: the scores of the methods.
        pairs: the comparisons of pairs; if empty, their table is left out.
        about: a line below the tables, on the data that was evaluated.
    """
    text = markdown_table(headings(scores), rows(scores))
    if pairs:
        text += "\n" + markdown_table(PAIR_HEADINGS, compared_rows(pairs))
    return f"{text}\n{about}\n"
