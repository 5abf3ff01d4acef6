"""Line charts as inline SVG that follow the page's colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

__all__ = ["decade_ticks", "line_chart", "standalone", "ticks"]

WIDTH, HEIGHT = 560, 300
LEFT, RIGHT, TOP, BOTTOM = 52, 118, 16, 40

Points = Sequence[tuple[float, float]]


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers that lie in a range.

    >>> ticks(0.0, 10.0)
    [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    """
    if not high > low:
        return [low]
    raw = (high - low) / count
    size = 10 ** math.floor(math.log10(raw))
    step = next(size * factor for factor in (1, 2, 2.5, 5, 10) if size * factor >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(index * step, 10) for index in range(first, math.floor(high / step + 1e-9) + 1)]


def decade_ticks(low: float, high: float) -> list[float]:
    """Logarithms of 1, 2 and 5 times powers of ten that lie in a range of logarithms.

    >>> [round(10**tick, 3) for tick in decade_ticks(-2.1, -1.2)]
    [0.01, 0.02, 0.05]
    """
    decades = range(math.floor(low), math.ceil(high) + 1)
    places = [decade + math.log10(factor) for decade in decades for factor in (1, 2, 5)]
    return [place for place in places if low <= place <= high]


def line_chart(
    series: Mapping[str, Points],
    title: str,
    unit: str,
    *,
    logarithmic: bool = False,
    horizontal: str = "steps",
    dense: bool = False,
) -> str:
    """A chart of several lines, each named at its end.

    Args:
        series: points (step, value) by name; lines without points are left out.
        title: for screen readers and the caption.
        unit: at the vertical axis.
        logarithmic: the vertical axis.
        horizontal: the name of the horizontal axis.
        dense: the horizontal axis shows log(1 + x), with a tick and a dot at every point: for few, growing numbers.

    Returns:
        An SVG element, or a remark where there is nothing to draw.
    """
    shown = {name: points for name, points in series.items() if points}
    if not shown:
        return f'<p class="quiet">{escape(title)}: nothing was recorded.</p>'
    form = math.log10 if logarithmic else float
    values = [form(max(y, 1e-9)) for points in shown.values() for _, y in points]
    last = max(x for points in shown.values() for x, _ in points)
    places = sorted({x for points in shown.values() for x, _ in points}) if dense else ticks(0, last)
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or 0.5
    low, high = low - margin, high + margin

    def across(x: float) -> float:
        fraction = math.log1p(x) / math.log1p(last) if dense and last else x / max(last, 1)
        return LEFT + (WIDTH - LEFT - RIGHT) * fraction

    def down(value: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - value) / (high - low)

    parts = []
    for tick in decade_ticks(low, high) if logarithmic else ticks(low, high):
        label = f"{10**tick:.2g}" if logarithmic else f"{tick:g}"
        y = down(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    for tick in places:
        x = across(tick)
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{tick:g}</text>')
    centre = f'x="{(LEFT + WIDTH - RIGHT) / 2:.0f}" y="{HEIGHT - 4}" text-anchor="middle"'
    parts.append(f"<text {centre}>{escape(horizontal)}</text>")
    parts.append(f'<text x="{LEFT - 40}" y="{TOP - 4}">{escape(unit)}</text>')
    ends = _apart({name: down(form(max(points[-1][1], 1e-9))) for name, points in shown.items()})
    for index, (name, points) in enumerate(shown.items()):
        path = " ".join(f"{across(x):.1f},{down(form(max(y, 1e-9))):.1f}" for x, y in points)
        x, y = across(points[-1][0]), down(form(max(points[-1][1], 1e-9)))
        for dot in points if dense else points[-1:]:
            place = f'cx="{across(dot[0]):.1f}" cy="{down(form(max(dot[1], 1e-9))):.1f}"'
            parts.append(f'<circle class="dot-{index % 4}" {place} r="3.5"/>')
        parts.append(f'<polyline class="line line-{index % 4}" points="{path}"/>')
        parts.append(
            f'<text class="name name-{index % 4}" x="{x + 8:.1f}" y="{ends[name] + 4:.1f}">{escape(name)}</text>'
        )
    return (
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg>"
    )


def standalone(chart: str) -> str:
    """A chart as an SVG file of its own, with the page's colours."""
    style = files("hyperplanes.demo").joinpath("style.css").read_text(encoding="utf-8")
    head = '<svg xmlns="http://www.w3.org/2000/svg" '
    return chart.replace("<svg ", head, 1).replace(">", f"><style>{style}</style>", 1) + "\n"


def _apart(places: Mapping[str, float], least: float = 15.0) -> dict[str, float]:
    """Labels moved down until none covers another."""
    result: dict[str, float] = {}
    previous = -math.inf
    for name, place in sorted(places.items(), key=lambda pair: pair[1]):
        previous = max(place, previous + least)
        result[name] = previous
    return result
