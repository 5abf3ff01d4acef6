"""Tables of the benchmark `views`: PSNR by object, method and number of views."""

from __future__ import annotations

from typing import Any

from benchmarks.parts.reporting import Row
from hyperplanes.adaptation.correction.residuals import MIN_CORRECTED_VIEWS
from hyperplanes.utilities.files.tables import markdown_table

__all__ = [
    "NAMES",
    "OF_CORRECTION",
    "Result",
    "views",
    "views_over",
    "views_residuals",
    "views_summary",
    "views_tuned",
]

Result = dict[str, Any]
"""The content of a file of results: the environment of the measurement, and the rows."""

SUMMARY = (3, 5, 25)  # numbers of views in the table of README.md
NAMES = {
    "cars": "cars",
    "chairs": "chairs",
    "planes": "planes",
    "spacecraft": "spacecraft",
    "lamps": "lamps",
    "random-unseen": "compositions of random shapes",
    "chair": "the Blender chair",
}
"""The names of the data sets of the suites in the documentation."""
METHODS = {
    "nearest_view": "the nearest view",
    "hull_blend": "`hull_blend`",
    "hull_blend_reflected": "`hull_blend` with reflections",
    "swapped": "the update of another object",
    "unreflected": "`small` without reflections",
    "unrotated": "`small` without a canonical frame",
    "one_step": "**`small`**",
}
"""The rows of the table `views`, in order."""


OF_CORRECTION = ("uncorrected", "residuals_alone")
"""The methods without residual correction, and without the network that computes it."""

RowsOfViews = dict[tuple[str, int], Row]  # by method and number of views


def _of_views(results: tuple[Result, ...]) -> tuple[dict[str, RowsOfViews], list[int]]:
    """The rows of each data set, by its name in the documentation, and all numbers of views."""
    found: dict[str, RowsOfViews] = {}
    for row in (row for result in results for row in result["rows"]):
        name = NAMES[row["data"].removeprefix("cc0-")]
        if row["suite"] == "cc0" or row["data"].startswith("cc0-"):
            name = f"CC0 {name}"
        found.setdefault(name, {})[row["name"], row["views"]] = row
    return found, sorted({count for rows in found.values() for _, count in rows})


def _table_of_views(counts: list[int], lines: list[list[str]]) -> str:
    return markdown_table(["", *(f"{count} view{'s' if count > 1 else ''}" for count in counts)], lines)


def views(*results: Result) -> str:
    """The table of the PSNR of all methods, for all numbers of views."""
    found, counts = _of_views(results)
    lines = []
    for name, rows in found.items():
        number = next(iter(rows.values()))["objects"]
        for method, label in METHODS.items():
            scores = [rows.get((method, count)) for count in counts]
            if any(scores):
                cells = (f"{row['psnr']:.2f}" if row else "-" for row in scores)
                lines.append([f"{name} ({number}): {label}", *cells])
    return _table_of_views(counts, lines)


def views_over(*results: Result) -> str:
    """The table of the gain of one forward pass of `small` over `hull_blend`."""
    found, counts = _of_views(results)
    lines = []
    for name, rows in found.items():
        cells = []
        for row in (rows.get(("one_step", count)) for count in counts):
            cells.append(_above(row or {}, "over_hull_blend"))
        lines.append([name, *cells])
    return _table_of_views(counts, lines)


def _above(row: dict[str, Any], name: str) -> str:
    """A difference and, if there are several objects, its 95 % interval."""
    if name not in row:
        return "-"
    if f"{name}_low" not in row:
        return f"{row[name]:+.2f}"
    return f"{row[name]:+.2f} ({row[f'{name}_low']:+.1f} to {row[f'{name}_high']:+.1f})"


def views_summary(*results: Result) -> str:
    """The table of README.md: the PSNR of `small` and, in parentheses, of `hull_blend`."""
    found, _ = _of_views(results)
    lines = []
    for name, rows in found.items():
        pairs = ((rows["one_step", count], rows["hull_blend", count]) for count in SUMMARY)
        lines.append([name, *(f"{ours['psnr']:.1f} ({blended['psnr']:.1f})" for ours, blended in pairs)])
    return _table_of_views(list(SUMMARY), lines)


def views_residuals(*results: Result) -> str:
    """The table of one forward pass of `small` without, with mean and with learned residual correction."""
    found, counts = _of_views(results)
    lines = []
    for name, rows in found.items():
        for count in (each for each in counts if each >= MIN_CORRECTED_VIEWS and ("residuals_alone", each) in rows):
            scores = [rows[method, count]["psnr"] for method in ("hull_blend", *OF_CORRECTION, "one_step")]
            over = [_above(rows["one_step", count], f"over_{method}") for method in OF_CORRECTION]
            objects = rows["one_step", count]["objects"]
            lines.append([f"{name} ({objects})", str(count), *(f"{score:.2f}" for score in scores), *over])
    headings = ["views", "`hull_blend`", "none", "mean residual", "network", "over none", "over the mean residual"]
    return markdown_table(["", *headings], lines)


def views_tuned(*results: Result) -> str:
    """The table of gradient steps from `small`, compared with as many from random weights."""
    found, counts = _of_views(results)
    lines = []
    for name, rows in found.items():
        for count in counts:
            scores = [rows[method, count]["psnr"] for method in ("hull_blend", "one_step", "100_steps", "scratch_100")]
            objects, seeds = rows["one_step", count]["objects"], rows["100_steps", count].get("seeds", 1)
            how_many = f"{objects}" if seeds == 1 else f"{objects}, {seeds} seeds"
            over = _above(rows["100_steps", count], "over_scratch_100")
            lines.append([f"{name} ({how_many})", str(count), *(f"{score:.2f}" for score in scores), over])
    headings = [
        "views",
        "`hull_blend`",
        "one forward pass",
        "100 steps",
        "100 from random weights",
        "over random weights",
    ]
    return markdown_table(["", *headings], lines)
