"""The page: one HTML file with everything in it, no script, nothing fetched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

from hyperplanes.demo.charts import Points, line_chart
from hyperplanes.demo.content import Exhibit, Look, Report, Row
from hyperplanes.demo.pictures import ERROR_SCALE, error_map, gradient, inline, inline_png

__all__ = ["render_page"]


def render_page(report: Report) -> str:
    """The whole page as text.

    Raises:
        ValueError: no exhibit, or a first method that the exhibits do not show.
    """
    if not report.exhibits or any(report.method not in look.predictions for e in report.exhibits for look in e.looks):
        raise ValueError(f"report: expected exhibits that show {report.method}, got {len(report.exhibits)} exhibits")
    methods = [row for row in report.table if row.method in report.exhibits[0].looks[0].predictions]
    style = files("hyperplanes.demo").joinpath("style.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.title)}</title>\n<style>\n{style}{_choices(methods)}</style>\n</head>\n<body>\n<main>\n"
        f"<header>\n<h1>{escape(report.title)}</h1>\n"
        f'<p class="lead">{escape(report.lead)}</p>\n{_figures(report.figures)}</header>\n'
        f"{_story(report.exhibits[0])}{_gallery(report, methods)}{_table(report.table)}{_tuning(report)}"
        f"{_curves(report.curves)}{_making(report)}</main>\n</body>\n</html>\n"
    )


def _choices(methods: Sequence[Row]) -> str:
    """Which predictions show for which tab, without a script."""
    rules = []
    for row in methods:
        name = row.method
        rules.append(f"#pick-{name}:checked ~ .gallery .of-{name} {{ display: block; }}")
        rules.append(
            f"#pick-{name}:checked ~ .tabs [for=pick-{name}] "
            "{ background: var(--ink); color: var(--paper); border-color: var(--ink); }"
        )
        rules.append(f"#pick-{name}:focus-visible ~ .tabs [for=pick-{name}] {{ outline: 3px solid var(--accent); }}")
    return "\n".join(rules) + "\n"


def _figures(figures: Sequence[tuple[str, str]]) -> str:
    cells = "".join(f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for value, what in figures)
    return f'<dl class="figures">{cells}</dl>\n'


def _story(exhibit: Exhibit) -> str:
    read = set(exhibit.read)
    order = [*exhibit.read, *(index for index in range(len(exhibit.support)) if index not in read)]
    shown = "".join(
        f'<img class="{"read" if index in read else "seen"}" alt="support view {index}" '
        f'src="{inline_png(exhibit.support[index])}">'
        for index in order
    )
    turntable = ""
    if exhibit.turntable:
        turntable = f'<img alt="turntable of {escape(exhibit.name)}" src="{inline(exhibit.turntable, "webp")}">'
    return (
        "<section>\n<h2>From a few images, in one forward pass</h2>\n"
        f"<p>The model has never seen {escape(exhibit.name)}. The hypernetwork reads the outlined images and writes "
        "new weights for the field; the field looks its colours up in all of them. Nothing is optimised.</p>\n"
        f'<div class="story card"><div><div class="shown">{shown}</div>'
        f'<p class="caption"><span class="key"></span>read by the hypernetwork; the others only lend their colours</p>'
        f'</div><div class="arrow" aria-hidden="true">&rarr;</div><div class="turn">{turntable}'
        '<p class="caption">every frame is a new view, rendered from the adapted field</p></div></div>\n</section>\n'
    )


def _gallery(report: Report, methods: Sequence[Row]) -> str:
    picks = "".join(
        f'<input class="pick" type="radio" name="pick" id="pick-{row.method}"'
        f"{' checked' if row.method == report.method else ''}>"
        for row in methods
    )
    tabs = "".join(f'<label for="pick-{row.method}">{escape(row.about)}</label>' for row in methods)
    cards = "".join(_card(exhibit, methods) for exhibit in report.exhibits)
    others = [exhibit for exhibit in report.exhibits[1:] if exhibit.turntable]
    wheel = "".join(
        f'<div class="turn"><img alt="turntable of {escape(e.name)}" src="{inline(e.turntable, "webp")}">'
        f'<p class="caption">{escape(e.name)}</p></div>'
        for e in others
    )
    return (
        "<section>\n<h2>Views that nobody showed it</h2>\n"
        "<p>Truth, prediction and error of objects and views that were held out. Choose a method to see what it makes "
        f"of the same views.</p>\n{picks}<div class='tabs' role='group' aria-label='method'>{tabs}</div>\n"
        f'<div class="gallery">{cards}</div>\n'
        f'<div class="scale"><span>error 0</span><i style="background: {gradient()}"></i>'
        f"<span>{ERROR_SCALE:.0%} or more of full brightness, mean over the channels</span></div>\n"
        f"{f'<div class=wheel>{wheel}</div>' if wheel else ''}</section>\n"
    )


def _card(exhibit: Exhibit, methods: Sequence[Row]) -> str:
    scores = "".join(
        f'<span class="score of of-{row.method}">{exhibit.psnr[row.method]:.1f} dB</span>'
        for row in methods
        if row.method in exhibit.psnr
    )
    looks = "".join(_look(look, methods) for look in exhibit.looks)
    heads = "<span>truth</span><span>prediction</span><span>error</span>"
    return (
        f'<article class="card"><header><h3>{escape(exhibit.name)}</h3>{scores}</header>'
        f'<div class="looks">{heads}{looks}</div></article>\n'
    )


def _look(look: Look, methods: Sequence[Row]) -> str:
    predicted, errors = [], []
    for row in methods:
        image = look.predictions[row.method]
        shown = f'<img class="of of-{row.method}" alt='
        predicted.append(f'{shown}"prediction by {row.method}" src="{inline_png(image)}">')
        errors.append(f'{shown}"error of {row.method}" src="{inline_png(error_map(image, look.truth))}">')
    truth = f'<img alt="truth" src="{inline_png(look.truth)}">'
    return f"<div>{truth}</div><div>{''.join(predicted)}</div><div>{''.join(errors)}</div>"


def _table(table: Sequence[Row]) -> str:
    best = max(row.psnr for row in table)
    rows = "".join(
        f'<tr class="{"best" if row.psnr == best else "other"}"><td>{escape(row.about)}'
        f'<small>{escape(row.method)}</small></td><td class="psnr">{row.psnr:.2f} &plusmn; {row.deviation:.2f} dB</td>'
        f"<td>{row.ssim:.3f}</td>"
        f"<td>{escape(row.adapt)}</td><td>{escape(row.render)}</td></tr>"
        for row in table
    )
    return (
        "<section>\n<h2>The table</h2>\n<p>Means over the query views of all held-out objects, every row through the "
        'same code.</p>\n<div class="card scroll"><table><thead><tr><th>method</th><th>PSNR</th><th>SSIM</th>'
        f"<th>to adapt</th><th>to render a view</th></tr></thead><tbody>{rows}</tbody></table></div>\n</section>\n"
    )


def _tuning(report: Report) -> str:
    chart = line_chart(
        report.tuning,
        "PSNR over fine-tuning steps",
        "dB",
        horizontal="fine-tuning steps on the support views",
        dense=True,
    )
    return (
        "<section>\n<h2>What adapting is worth</h2>\n"
        f"<p>{escape(report.diagnostics)}</p>\n<p>Gradient steps on the support views, from the update of the "
        "hypernetwork and from random weights; PSNR on the query views.</p>\n"
        f'<div class="charts"><figure class="card">{chart}</figure></div>\n</section>\n'
    )


def _curves(curves: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    quality: dict[str, Points] = {
        name: [(entry["step"], entry["psnr"]) for entry in curve if "psnr" in entry] for name, curve in curves.items()
    }
    loss: dict[str, Points] = {name: _smooth(curve) for name, curve in curves.items()}
    return (
        "<section>\n<h2>How it learned</h2>\n<p>Quality on some views of held-out objects while it trained, and the "
        'loss of the rays of each step, averaged over a few.</p>\n<div class="charts">'
        f'<figure class="card">{line_chart(quality, "PSNR on held-out objects", "dB, held-out")}</figure>'
        f'<figure class="card">{line_chart(loss, "training loss", "loss", logarithmic=True)}</figure>'
        "</div>\n</section>\n"
    )


def _smooth(curve: Sequence[Mapping[str, float]], window: int = 5) -> Points:
    return [
        (entry["step"], sum(e["loss"] for e in curve[max(0, i - window + 1) : i + 1]) / min(i + 1, window))
        for i, entry in enumerate(curve)
    ]


def _making(report: Report) -> str:
    facts = "".join(f"<dt>{escape(label)}</dt><dd>{escape(value)}</dd>" for label, value in report.facts)
    commands = "".join(
        f'<p class="quiet" style="margin:0">{escape(what)}</p><pre>{escape(command)}</pre>'
        for what, command in report.commands
    )
    return f'<section>\n<h2>How it was made</h2>\n<dl class="facts">{facts}</dl>\n{commands}</section>\n'
