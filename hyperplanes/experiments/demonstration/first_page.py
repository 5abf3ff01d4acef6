"""The first page of a demonstration: what the packaged model makes of objects that no training saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from hyperplanes.adaptation import HyperPlanes, NearestView
from hyperplanes.adaptation.base import Adapter, Pictures
from hyperplanes.adaptation.checkpoints import packaged_folder
from hyperplanes.data.support import Shown
from hyperplanes.evaluation import ObjectScore, Score, evaluate
from hyperplanes.experiments.page.content import Exhibit, QueryView, Report, Row
from hyperplanes.experiments.page.page import render_page
from hyperplanes.export.images import encode_animation, orbit_cameras, to_pixels
from hyperplanes.utilities.files import write_whole
from hyperplanes.utilities.formatting import format_duration
from hyperplanes.views import Task, Tasks

__all__ = ["COUNTS", "PACKAGED", "write_first_page"]

PACKAGED = "small"
COUNTS = (3, 10, 25)
"""Numbers of views that are shown of each object."""

QUERY_VIEWS = 2  # query views of each object on the page


def write_first_page(
    path: Path,
    data: Tasks,
    names: Sequence[str],
    frames: int,
    report: Callable[[str, float], None],
    counts: Sequence[int] = COUNTS,
) -> Path:
    """Write the page.

    Args:
        path: of the page.
        data: where the objects come from.
        names: of the objects, of any classes.
        frames: of each turntable.
        report: called with every row's name and its PSNR in dB.
        counts: numbers of views that are shown, ascending.

    Returns:
        The page.
    """
    model, most = HyperPlanes.from_pretrained(packaged_folder(PACKAGED)), counts[-1]
    rows: dict[str, tuple[str, int, Adapter]] = {
        "nearest_view": (f"nearest of {most} views, copied", most, NearestView()),
        **{f"views_{count}": (f"{count} views", count, model) for count in counts},
    }
    pictures: dict[str, dict[str, Pictures]] = {}
    scores: dict[str, Score] = {}
    for row, (about, count, adapter) in rows.items():

        def keep(score: ObjectScore, task: Task, made: Pictures, row: str = row) -> None:
            pictures.setdefault(row, {})[score.name] = made

        scores[row] = evaluate(row, adapter, Shown(data, count, QUERY_VIEWS), names, keep)
        report(about, scores[row].mean("psnr"))
    exhibits = []
    for name in names:
        task = Shown(data, most, QUERY_VIEWS).task(name)
        truth = to_pixels(task.query.images)
        made = {row: to_pixels(found[name].images) for row, found in pictures.items()}
        views = [QueryView(truth[view], {row: made[row][view] for row in rows}) for view in range(len(truth))]
        quality = {row: next(each.psnr for each in scores[row].objects if each.name == name) for row in rows}
        around = orbit_cameras(task.support, frames)
        turntable = encode_animation(to_pixels(model.adapt(task.support).render(around).images), "webp")
        support = to_pixels(task.support.images)
        exhibits.append(Exhibit(name.rpartition("/")[2], support, range(len(support)), views, quality, turntable))
    last = scores[f"views_{most}"]
    page = Report(
        title="New views of objects it has never seen",
        lead=f"The packaged model {PACKAGED!r} looks at posed images of an object, any number of them from anywhere, "
        "and writes the weights of a field that can be looked at from anywhere. Nothing was trained for this page.",
        figures=[
            (f"{last.mean('psnr'):.2f} dB", f"PSNR from {most} views, in a single step"),
            (f"{scores[f'views_{counts[0]}'].mean('psnr'):.2f} dB", f"from {counts[0]} views"),
            (format_duration(last.mean("adapt_seconds")), f"from {most} images to a field"),
            (format_duration(last.mean("render_seconds")), f"a view of {truth.shape[1]} x {truth.shape[2]} pixels"),
        ],
        method=f"views_{most}",
        exhibits=exhibits,
        table=[_row(row, about, scores[row]) for row, (about, _, _) in rows.items()],
        curves={},
        tuning={},
        diagnostics="",
        facts=[("weights", f"{PACKAGED}, which comes with the package"), ("objects", ", ".join(names))],
        commands=[
            (
                "a turntable of your own posed images (transforms.json beside them)",
                f"hyperplanes render --checkpoint {PACKAGED} --views photos/ --out new-views --orbit 48 --all-views",
            ),
            (
                "the same after 100 steps on those images, which makes it sharper",
                f"hyperplanes render --checkpoint {PACKAGED} --views photos/ --out sharper --steps 100 --all-views",
            ),
        ],
    )
    write_whole(path, render_page(page).encode())
    return path


def _row(name: str, about: str, score: Score) -> Row:
    seconds = [format_duration(score.mean(each)) for each in ("adapt_seconds", "render_seconds")]
    foreground = score.mean("psnr_foreground") if "psnr_foreground" in score.quantities else None
    return Row(
        name, about, score.mean("psnr"), score.spread("psnr"), foreground, score.mean("ssim"), seconds[0], seconds[1]
    )
