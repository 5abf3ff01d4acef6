"""The page: one self-contained HTML file without scripts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files

from hyperplanes.experiments.page.charts import line_chart
from hyperplanes.experiments.page.content import Report
from hyperplanes.experiments.page.pictures import ERROR_SCALE, error_map, gradient, inline, inline_png

__all__ = ["render_page"]

Points = Sequence[tuple[float, float]]


def render_page(report: Report) -> str:
    """The HTML text of the page.

    Raises:
        ValueError: no exhibit, or exhibits without pictures of the method that is selected at first.
    """
    from jinja2 import Environment, StrictUndefined

    if not report.exhibits or any(report.method not in view.predictions for e in report.exhibits for view in e.views):
        raise ValueError(f"report: expected exhibits that show {report.method}, got {len(report.exhibits)} exhibits")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters |= {"png": inline_png, "inline": inline, "error": error_map}
    folder = files("hyperplanes.experiments.page")
    methods = [row for row in report.table if row.method in report.exhibits[0].views[0].predictions]
    return environment.from_string(folder.joinpath("report.html").read_text(encoding="utf-8")).render(
        report=report,
        methods=methods,
        best=max(row.psnr for row in methods),  # without the rows on other objects
        charts=_charts(report),
        style=folder.joinpath("style.css").read_text(encoding="utf-8"),
        gradient=gradient(),
        error_scale=ERROR_SCALE,
    )


def _charts(report: Report) -> Mapping[str, str]:
    """The charts as data URIs; empty strings for charts without points."""
    quality = {
        name: [(entry["step"], entry["psnr"]) for entry in curve if "psnr" in entry]
        for name, curve in report.curves.items()
    }
    loss = {name: _smooth(curve) for name, curve in report.curves.items()}
    return {
        "tuning": line_chart(report.tuning, "PSNR (dB)", "fine-tuning steps on the support views", counts=True),
        "quality": line_chart(quality, "PSNR on held-out objects (dB)"),
        "loss": line_chart(loss, "loss", logarithmic=True),
    }


def _smooth(curve: Sequence[Mapping[str, float]], window: int = 5) -> Points:
    return [
        (entry["step"], sum(e["loss"] for e in curve[max(0, i - window + 1) : i + 1]) / min(i + 1, window))
        for i, entry in enumerate(curve)
    ]
