"""From the folder of a demonstration to its page and its picture."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.adaptation.diagnostics import Diagnostics
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.experiments.demonstration.pipeline import MODELS, DemoSettings, describe_row
from hyperplanes.experiments.page import Exhibit, QueryView, Report, Row, render_page
from hyperplanes.experiments.page.content import Pixels
from hyperplanes.experiments.stages import Stages
from hyperplanes.export.images import encode_animation, orbit_cameras, to_pixels
from hyperplanes.utilities.checkpoints import read_json
from hyperplanes.utilities.encoding import encode_png
from hyperplanes.utilities.environment import environment
from hyperplanes.utilities.files import write_whole
from hyperplanes.utilities.formatting import format_duration
from hyperplanes.views import Tasks

__all__ = ["describe", "how_it_was_made", "overview", "write_report"]

HERO_SCALE, SCALE = 2.5, 1.5
"""Sides of turntables as multiples of the images': of the first object, which is shown large, and of the others."""

GAP = 6


def write_report(
    folder: Path, data: Tasks, settings: DemoSettings, metrics: Mapping[str, Any], facts: Sequence[tuple[str, str]]
) -> Path:
    """Write report.html and overview.png.

    Args:
        folder: of the demonstration, everything before the report done.
        data: its data set.
        settings: of the demonstration.
        metrics: what `write_metrics` returned.
        facts: how it was made, label and value.

    Returns:
        The page.
    """
    model = HyperPlanes.from_pretrained(find_checkpoint(folder / "hyperplanes"))
    exhibits, rounds = [], []
    for name in sorted(data.names("test"))[: settings.exhibits]:
        task = data.task(name)
        support = model.arrange(task.support)
        size = round((SCALE if exhibits else HERO_SCALE) * settings.resolution)
        frames = to_pixels(model.adapt(support).render(orbit_cameras(support, settings.frames, size=size)).images)
        rounds.append(frames)
        truth = to_pixels(task.query.images)
        chosen = sorted({len(truth) // 4, 3 * len(truth) // 4})
        views = [QueryView(truth[i], _predictions(folder, settings, name, task.query.names[i])) for i in chosen]
        quality = {method: metrics[method]["objects"][name]["psnr"] for method in settings.methods}
        read = model.prepare(task.support, carved=False).hyperplanes.tolist()
        exhibits.append(
            Exhibit(name, to_pixels(support.images), read, views, quality, encode_animation(frames, "webp"))
        )
    curves = {method: read_json(folder / method / "training.json")["curve"] for method in MODELS}
    picture = overview(exhibits[:3], rounds[:3], round(SCALE * settings.resolution))
    write_whole(folder / "overview.png", encode_png(picture, small=True))
    page = render_page(describe(folder, settings, metrics, exhibits, curves, facts))
    write_whole(folder / "report.html", page.encode())
    return folder / "report.html"


def _predictions(folder: Path, settings: DemoSettings, name: str, view: str) -> dict[str, Pixels]:
    file = f"{Path(view).stem}.png"
    return {method: _read(folder / "pictures" / method / name / file) for method in settings.methods}


def _read(path: Path) -> Pixels:
    with Image.open(path, formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))


def describe(
    folder: Path,
    settings: DemoSettings,
    metrics: Mapping[str, Any],
    exhibits: Sequence[Exhibit],
    curves: Mapping[str, Sequence[Mapping[str, float]]],
    facts: Sequence[tuple[str, str]],
) -> Report:
    """The page's content in words and numbers."""
    one_step = metrics["hyperplanes"]
    table = [
        Row(
            row,
            describe_row(row),
            found["psnr"],
            statistics.pstdev(each["psnr"] for each in found["objects"].values()),
            found.get("psnr_foreground"),
            found["ssim"],
            format_duration(found["adapt_seconds"]),
            format_duration(found["render_seconds"]),
        )
        for row, found in metrics.items()
    ]
    tuning = {
        method: sorted((float(steps), quality) for steps, quality in found.items())
        for method, found in read_json(folder / "tuning.json").items()
    }
    diagnostics = Diagnostics.of_json(read_json(folder / "hyperplanes" / "diagnostics.json"))
    gap = one_step["psnr"] - metrics["hyperplanes_swapped"]["psnr"]
    shown = len(exhibits[0].support)
    return Report(
        title="New views of objects it has never seen",
        lead=f"A hypernetwork looks at a few of {shown} posed images of a {settings.class_name} and writes the weights "
        "of a field that can be looked at from anywhere.",
        figures=[
            (f"{one_step['psnr']:.2f} dB", "PSNR on held-out objects after a single step"),
            (f"{one_step['ssim']:.3f}", "SSIM of the same views"),
            (format_duration(one_step["adapt_seconds"]), f"from {shown} images to a field"),
            (
                format_duration(one_step["render_seconds"]),
                f"a view of {settings.resolution} x {settings.resolution} pixels",
            ),
        ],
        method="hyperplanes",
        exhibits=exhibits,
        table=table,
        curves=curves,
        tuning=tuning,
        diagnostics=f"Over held-out objects, {diagnostics}. In the table, an object's own update is worth {gap:.2f} dB "
        "more than that of another object.",
        facts=facts,
        commands=[
            ("this page again, or what is left of it after an interruption", f"hyperplanes demo --out {folder}"),
            (
                "a turntable of your own posed images (transforms.json beside them)",
                f"hyperplanes render --checkpoint {folder} --views photos/ --out new-views --orbit 48",
            ),
            (
                "a mesh with coloured vertices",
                f"hyperplanes export --checkpoint {folder} --views photos/ --out model --what mesh --mesh-format glb",
            ),
        ],
    )


def how_it_was_made(settings: DemoSettings, folder: Path, manifest: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Data, training, machine and time, label and value."""
    done, where = Stages(folder), environment()
    steps = read_json(folder / "hyperplanes" / "training.json")["step"]
    trained = settings.objects - settings.held_out
    times = ", ".join(
        f"{name} {format_duration(done.seconds(name))}" for name in ("data", *MODELS) if done.seconds(name)
    )
    return [
        ("objects", f"{trained} procedural {settings.class_name}s to train on, {settings.held_out} held out"),
        (
            "images",
            f"{settings.views} an object, {settings.resolution} px, half support, half query",
        ),
        ("renderer of the data", str(manifest.get("renderer", "unknown"))),
        ("training", f"{steps:,} steps of each model, preset {settings.preset}, seed {settings.seed}"),
        ("time", times),
        ("machine", f"{where['gpu'] or where['processor']}, {where['cores']} cores, torch {where['torch']}"),
        ("commit", str(where["commit"])),
        ("paper", "Batorski et al., HyperPlanes: Hypernetwork Approach to Rapid NeRF Adaptation, arXiv 2402.01524"),
    ]


def overview(exhibits: Sequence[Exhibit], rounds: Sequence[Pixels], side: int, columns: int = 7) -> Pixels:
    """One picture of it all: a row an object, on the left what was read, on the right new views around it.

    Args:
        exhibits: the objects.
        rounds: the frames of their turntables.
        side: of every picture in it, in pixels.
        columns: new views a row.

    Returns:
        Pixels (height, width, 3).
    """
    rows = []
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
