"""The pages of the demonstration: one on the packaged model, and one on the models that were trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from PIL import Image

from hyperplanes.adaptation.checkpoints import find_checkpoint, packaged_folder
from hyperplanes.adaptation.correction.held_out import MIN_VIEWS
from hyperplanes.adaptation.diagnostics import Diagnostics
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.data.dataset import read_task
from hyperplanes.data.packaged import EXAMPLES
from hyperplanes.data.support import FarthestSupport
from hyperplanes.evaluation import Score
from hyperplanes.experiments.demonstration.settings import (
    BASELINES,
    MODELS,
    PACKAGED_MODEL,
    QUERY_VIEWS,
    DemoSettings,
    describe_row,
)
from hyperplanes.experiments.engine import ORBIT, Runner, curve_of
from hyperplanes.experiments.page import Exhibit, QueryView, Report, Row, render_page
from hyperplanes.experiments.page.content import Pixels
from hyperplanes.experiments.paper.experiment import Cell
from hyperplanes.export.images import encode_animation, orbit_cameras, picture_paths, to_pixels
from hyperplanes.geometry.cameras import resized
from hyperplanes.methods import describe_method
from hyperplanes.utilities.files.checkpoints import read_json
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.reading import MANIFEST
from hyperplanes.utilities.files.writing import write_json, write_whole
from hyperplanes.utilities.machine.environment import environment
from hyperplanes.utilities.messages.formatting import format_duration
from hyperplanes.utilities.messages.shell import command_line
from hyperplanes.views import Task, Views

__all__ = ["compile_kernels", "describe_count", "overview", "write_first_page", "write_report"]

HERO_SCALE, SCALE = 2.5, 1.5
"""Sides of turntables as multiples of the side of the images: for the first object, which is large, and the others."""

GAP = 6

TITLE = "New views of held-out objects"


def write_first_page(path: Path, runner: Runner, settings: DemoSettings, scores: Mapping[str, Score]) -> None:
    """Write a page with new views by the packaged model, of objects that it was not trained on.

    Args:
        path: the file of the page.
        runner: the runner of `settings.packaged`, after all its cells were evaluated.
        settings: the settings of the demonstration.
        scores: the scores by row, over all classes.
    """
    fewest, most = settings.first_counts[0], settings.first_counts[-1]
    best = f"views_{most}"
    exhibits, names = [], []
    for on in dict.fromkeys(cell.on for cell in settings.packaged.cells):
        cells = [cell for cell in settings.packaged.cells if cell.on == on]
        for name in runner.data.evaluated(on, "all", settings.packaged.objects):
            task = FarthestSupport(runner.data.tasks(on), most, QUERY_VIEWS).task(name)
            shown = next(runner.pictures(cell, name) for cell in cells if cell.orbit)
            around = np.stack([_read(frame) for frame in picture_paths(settings.first_frames, shown / ORBIT)])
            read, query = range(len(task.support)), range(len(task.query))
            exhibits.append(_exhibit(runner, cells, scores, task, read, query, around))
            names.append(f"{on}/{name}")
    height, width = task.query.size
    page = Report(
        title=TITLE,
        lead=f"The packaged model {PACKAGED_MODEL!r} reads posed images of an object, any number of them from any "
        "viewpoints, and predicts the weights of a field, which is rendered from new viewpoints. Nothing was trained "
        "for this page.",
        figures=[
            (f"{scores[best].mean('psnr'):.2f} dB", f"PSNR from {most} views, after one forward pass"),
            (f"{scores[f'views_{fewest}'].mean('psnr'):.2f} dB", f"from {fewest} views"),
            (format_duration(scores[best].mean("adapt_seconds")), f"from {most} images to a field"),
            (format_duration(scores[best].mean("render_seconds")), f"a view of {height} x {width} pixels"),
        ],
        method=best,
        exhibits=exhibits,
        table=[_row(row, describe_count(row, most), score) for row, score in scores.items()],
        curves={},
        tuning={},
        diagnostics="",
        facts=[("weights", f"{PACKAGED_MODEL}, which comes with the package"), ("objects", ", ".join(names))],
        commands=[
            (
                "a turntable of your own posed images (a folder with transforms.json)",
                f"hyperplanes render --checkpoint {PACKAGED_MODEL} --views scene "
                "--out new-views --orbit 48 --all-views",
            ),
            (
                "the same after 100 steps on those images, which makes it sharper",
                f"hyperplanes render --checkpoint {PACKAGED_MODEL} --views scene --out sharper --steps 100 --all-views",
            ),
        ],
    )
    write_whole(path, render_page(page).encode())


def _round(model: HyperPlanes, support: Views, cameras: PinholeCamera) -> Pixels:
    """The frames of a turntable after one forward pass.

    They are rendered from the field. For so few small frames, baking and fitting voxels takes longer than 36 frames of
    160x160 from the field (13 s on one core), and the result is 1.0 dB lower on the query views of a held-out car.
    """
    return to_pixels(model.adapt(support).render(cameras).images)


def compile_kernels(device: torch.device) -> None:
    """Compile and load everything that rendering with the packaged model needs, by one small view of an example."""
    example = read_task(EXAMPLES / "example-car")
    model = HyperPlanes.from_pretrained(packaged_folder(PACKAGED_MODEL)).to(device)
    model.config = replace(model.config, symmetric=False)  # the search for symmetry takes time and compiles nothing
    few = example.support[:MIN_VIEWS].resized(32)  # enough views for stacking
    model.adapt(few).render(resized(example.query[:1].cameras, 32, 32))


def describe_count(row: str, most: int) -> str:
    """The description of a row of the first page."""
    if row in BASELINES:
        return f"{describe_method(row)} ({most} views)"
    return f"{row.removeprefix('views_')} views"


def write_report(folder: Path, runner: Runner, settings: DemoSettings) -> None:
    """Write metrics.json, report.html and overview.png.

    Args:
        folder: the folder of the demonstration.
        runner: the runner of `settings.table`, after fine-tuning.
        settings: the settings of the demonstration.
    """
    scores = {cell.row: runner.score(settings.table, cell, settings.seed) for cell in settings.table.cells}
    write_json(folder / "metrics.json", {row: score.as_json() for row, score in scores.items()})
    checkpoint, data = find_checkpoint(folder / "hyperplanes"), runner.data.tasks(settings.class_name)
    names = sorted(data.names("test"))[: settings.exhibits]
    sides = [round((SCALE if place else HERO_SCALE) * settings.resolution) for place in range(len(names))]
    works = [partial(_turntable, checkpoint, settings, *each) for each in zip(names, sides, strict=True)]
    rounds = runner.do_all(settings.class_name, works)
    model = HyperPlanes.from_pretrained(checkpoint).to(runner.device)
    cells = [cell for cell in settings.table.cells if cell.row in settings.methods]
    exhibits = []
    for name, around in zip(names, rounds, strict=True):
        task = data.task(name)
        read, count = model.prepare(task.support, carved=False).hyperplanes.tolist(), len(task.query)
        task = replace(task, support=model.arrange(task.support))
        query = sorted({count // 4, 3 * count // 4})
        exhibits.append(_exhibit(runner, cells, scores, task, read, query, around))
    picture = overview(exhibits[:3], rounds[:3], round(SCALE * settings.resolution))
    write_whole(folder / "overview.png", encode_png(picture, small=True))
    write_whole(folder / "report.html", render_page(_describe(folder, runner, settings, scores, exhibits)).encode())


def _turntable(checkpoint: Path, settings: DemoSettings, name: str, side: int, runner: Runner) -> Pixels:
    """The frames of the turntable of an object of the training class, with `side` x `side` pixels."""
    model = HyperPlanes.from_pretrained(checkpoint).to(runner.device)
    support = model.arrange(runner.data.tasks(settings.class_name).task(name).support)
    return _round(model, support, orbit_cameras(support, settings.frames, size=side))


def _exhibit(
    runner: Runner,
    cells: Sequence[Cell],
    scores: Mapping[str, Score],
    task: Task,
    read: Sequence[int],
    query: Sequence[int],
    around: Pixels,
) -> Exhibit:
    """An object on the page: its support views, those that are read, some query views by each cell, and a turntable."""
    truth, names = to_pixels(task.query.images), [f"{Path(name).stem}.png" for name in task.query.names]
    files = {cell.row: runner.pictures(cell, task.name) for cell in cells}
    views = [
        QueryView(truth[view], {row: _read(folder / names[view]) for row, folder in files.items()}) for view in query
    ]
    quality = {row: next(each.psnr for each in scores[row].objects if each.name == task.name) for row in files}
    support = to_pixels(task.support.images)
    return Exhibit(task.name, support, read, views, quality, encode_animation(around, "webp"))


def _read(path: Path) -> Pixels:
    with Image.open(path, formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))


def _row(row: str, about: str, score: Score) -> Row:
    seconds = [format_duration(score.mean(each)) for each in ("adapt_seconds", "render_seconds")]
    foreground = score.mean("psnr_foreground") if "psnr_foreground" in score.quantities else None
    return Row(row, about, score.mean("psnr"), score.spread("psnr"), foreground, score.mean("ssim"), *seconds)


def _describe(
    folder: Path,
    runner: Runner,
    settings: DemoSettings,
    scores: Mapping[str, Score],
    exhibits: Sequence[Exhibit],
) -> Report:
    """The content of the page."""
    one_step = scores["hyperplanes"]
    diagnostics = Diagnostics.of_json(read_json(folder / "hyperplanes" / "diagnostics.json"))
    gap = one_step.mean("psnr") - scores["hyperplanes_swapped"].mean("psnr")
    shown, side = len(exhibits[0].support), settings.resolution
    given = ["--checkpoint", folder, "--views", "scene"]
    return Report(
        title=TITLE,
        lead=f"A hypernetwork reads a few of {shown} posed images of a {settings.class_name} and predicts the weights "
        "of a field, which is rendered from new viewpoints.",
        figures=[
            (f"{one_step.mean('psnr'):.2f} dB", "PSNR on held-out objects after one forward pass"),
            (f"{one_step.mean('ssim'):.3f}", "SSIM of the same views"),
            (format_duration(one_step.mean("adapt_seconds")), f"from {shown} images to a field"),
            (format_duration(one_step.mean("render_seconds")), f"a view of {side} x {side} pixels"),
        ],
        method="hyperplanes",
        exhibits=exhibits,
        table=[_row(row, describe_row(row), score) for row, score in scores.items()],
        curves={method: curve_of(folder / method) for method in MODELS},
        tuning={
            method: sorted((float(steps), quality) for steps, quality in found.items())
            for method, found in read_json(folder / "tuning.json").items()
        },
        diagnostics=f"Over held-out objects, {diagnostics}. In the table, PSNR with an object's own update is "
        f"{gap:.2f} dB higher than with the update of another object.",
        facts=_how_it_was_made(settings, folder, runner),
        commands=[
            ("this page, or the rest of it after an interruption", settings.command(folder)),
            (
                "a turntable of your own posed images (a folder with transforms.json)",
                command_line("hyperplanes", "render", given, "--out", "new-views", "--orbit", 48),
            ),
            (
                "a mesh with a texture",
                command_line("hyperplanes", "export", given, "--out", "model", "--what", "mesh"),
            ),
        ],
    )


def _how_it_was_made(settings: DemoSettings, folder: Path, runner: Runner) -> list[tuple[str, str]]:
    """Labels and values on the data, the training, the time and the machine."""
    where, trained = environment(), settings.objects - settings.held_out
    steps = read_json(folder / "hyperplanes" / "training.json")["step"]
    manifest = read_json(runner.data.folder(settings.class_name) / MANIFEST)
    times = {name: runner.workspace.record.seconds(name) for name in ("data", *MODELS)}
    times["data"] += runner.workspace.record.seconds("unseen")
    count = 1 if runner.workers is None else runner.workers.count
    beside = f"in one of {count} processes side by side, of one thread each" if count > 1 else "in one process, alone"
    return [
        ("objects", f"{trained} procedural {settings.class_name}s to train on, {settings.held_out} held out"),
        ("images", f"{settings.views} an object, {settings.resolution} px, half support, half query"),
        ("renderer of the data", str(manifest.get("renderer", "unknown"))),
        ("training", f"{steps:,} steps of each model, preset {settings.preset}, seed {settings.seed}"),
        ("time", ", ".join(f"{name} {format_duration(seconds)}" for name, seconds in times.items())),
        ("seconds to adapt and a view", f"measured {beside}"),
        ("machine", f"{where['gpu'] or where['processor']}, {where['cores']} cores, torch {where['torch']}"),
        ("commit", str(where["commit"])),
        ("paper", "Batorski et al., HyperPlanes: Hypernetwork Approach to Rapid NeRF Adaptation, arXiv 2402.01524"),
    ]


def overview(exhibits: Sequence[Exhibit], rounds: Sequence[Pixels], side: int) -> Pixels:
    """An overview in one picture: a row per object, with images that were read on the left and new views on the right.

    Args:
        exhibits: the objects.
        rounds: the frames of their turntables.
        side: the side of every picture in it, in pixels.

    Returns:
        Pixels (height, width, 3).
    """
    rows, columns = [], 7  # new views a row
    for exhibit, frames in zip(exhibits, rounds, strict=True):
        read = [_resized(exhibit.support[index], side) for index in exhibit.read[:5]]
        new = [_resized(frames[round(column * len(frames) / columns) % len(frames)], side) for column in range(columns)]
        edge = np.full((side, GAP, 3), 255, np.uint8)
        rule = np.full((side, 2, 3), 200, np.uint8)
        tiles = [piece for tile in read for piece in (tile, edge)] + [rule] + [p for tile in new for p in (edge, tile)]
        rows += [np.concatenate(tiles, 1), np.full((GAP, sum(t.shape[1] for t in tiles), 3), 255, np.uint8)]
    return np.concatenate(rows[:-1], 0)


def _resized(pixels: Pixels, side: int) -> Pixels:
    return np.asarray(Image.fromarray(pixels).resize((side, side), Image.Resampling.LANCZOS))
