"""Generate a data set: objects stream through worker processes into files; interrupted, it resumes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_gen import SUPERSAMPLE
from data_gen.datasets.layouts import LAYOUTS
from data_gen.datasets.manifest import GenerationState, build_manifest
from data_gen.datasets.objects import rig_of
from data_gen.datasets.sources import Item, MeshFolder, Procedural, Source, list_items
from data_gen.datasets.workers import Outcome, WorkerError, run_isolated
from data_gen.rigs import OBJECT_RADIUS, RIG_PRESETS, RIGS
from hyperplanes.data.errors import DataError
from hyperplanes.data.files import sha256

__all__ = ["ENGINES", "MeshFolder", "Procedural", "GenerationReport", "generate"]

ENGINES = ("local", "ray")
"""Where objects are rendered: worker processes of this machine, or a Ray cluster."""

PICTURES = 2
"""Raised whenever the same arguments come to give other bytes, so that no data set is made half of each."""

VIEWS, RESOLUTION = 50, 64
MOST_VIEWS, MOST_SAMPLES, MOST_BYTES = 10_000, 16_384, 4 * 2**30  # an object; along a side; of all its pictures
TARGET = "data_gen.datasets.objects:open_renderer"
EXTRA_CHANNELS = ("depth", "normals", "coordinates", "mesh")


@dataclass(frozen=True)
class GenerationReport:
    """What came of a generation.

    Attributes:
        written: objects in the data set, those of an earlier, interrupted call included.
        skipped: names and reasons of objects that are not in it.
        seconds: that this call took.
        images_per_second: that this call wrote.
        reused: objects that an earlier call had written.
        splits: how many objects are in each split.
        unlisted: objects that the split file does not name, and that are trained on.
    """

    written: int
    skipped: list[tuple[str, str]]
    seconds: float
    images_per_second: float
    reused: int = 0
    splits: dict[str, int] = field(default_factory=dict)
    unlisted: list[str] = field(default_factory=list)


def generate(
    source: Source,
    out: str | Path,
    *,
    rig: str = "fixed",
    views: int | None = None,
    resolution: int | None = None,
    lighting: str = "studio",
    channels: Sequence[str] = ("rgba",),
    held_out: float | int | None = None,
    workers: int | None = None,
    engine: str = "local",
    layout: str = "native",
    seed: int = 0,
    distance: float | None = None,
    field_of_view: float | None = None,
    supersample: int = SUPERSAMPLE,
    renderer: str | None = None,
    timeout: float = 300.0,
    recycle: int = 200,
    verify: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> GenerationReport:
    """Render objects into a data set.

    The same arguments give the same bytes, however often the work was interrupted, on any number of workers. An
    object that cannot be drawn, or whose worker crashes or hangs twice, is skipped and listed; the rest goes on.

    Args:
        source: procedural objects or mesh files.
        out: the folder; new, empty, or one in which the same generation was interrupted.
        rig: "fixed" (the same poses for all objects), "random" (on the sphere), "hemisphere", "orbit", or a name in
            `data_gen.rigs.RIG_PRESETS`.
        views: pictures an object, alternately support and query; the preset's when None, else 50.
        resolution: pixels along a side; what the layout or the preset takes for granted when None, else 64.
        lighting: "studio", "headlight" or "random".
        channels: "rgba" and any of "depth", "normals", "coordinates", "mesh"; more than rgba needs the native layout.
        held_out: objects for the test split, a count or a fraction below 1; see `data_gen.datasets.sources.list_items`.
        workers: processes; as many as cores when None.
        engine: "local", or "ray" for a Ray cluster.
        layout: a name in `data_gen.datasets.layouts.LAYOUTS`.
        seed: of random rigs and lights; shapes have their own in the source.
        distance: of the cameras from the object's centre in object radii; what suits the layout or the preset when
            None.
        field_of_view: in degrees; the preset's when None, or the object just fits.
        supersample: samples along a side of a pixel.
        renderer: a name in `data_gen.rendering.renderers.RENDERERS`; the best that works here when None.
        timeout: seconds an object may take.
        recycle: objects after which a worker is replaced.
        verify: compare files of an earlier call with their checksums, and make objects anew where they differ.
        progress: called with (objects done, objects in all, name) after each object.

    Returns:
        What was written and what was skipped.

    Raises:
        ValueError: an argument that makes no sense, a renderer that does not work, no object that could be drawn.
        DataError: the folder holds something else, or the disk is full.
    """
    begun = time.monotonic()
    out = Path(out)
    _check(rig, channels, engine, layout)
    views, resolution = _sizes(rig, layout, views, resolution)
    _refuse_absurd(views, resolution, supersample, channels)
    items = list_items(source, held_out)
    settings = _settings(source, locals())
    settings["out"] = str(out.resolve())
    with GenerationState(out, _configuration(source, items, settings, held_out)) as state:
        done = state.done(verified=verify)
        reused = sum(item.name in done for item in items)
        todo = (asdict(item) for item in items if item.name not in done)
        count, skipped, images = reused, [], 0
        try:
            with closing(_outcomes(engine, settings, todo, workers, timeout, recycle)) as outcomes:
                for outcome in outcomes:
                    count += 1
                    name = outcome.item["name"]
                    if outcome.result is None:
                        skipped.append((name, _without_path(str(outcome.reason), source)))
                    else:
                        done[name] = outcome.result
                        images += outcome.result["record"]["views"]
                    if progress is not None:
                        progress(count, len(items), name)
        except WorkerError as error:
            raise DataError(str(error)) from error
        if not any(item.name in done for item in items):
            name, reason = skipped[0]
            raise ValueError(f"{out}: none of {len(items)} objects could be drawn; {name}: {reason}")
        kept = [item for item in items if item.name in done]
        facts = _facts(settings)
        manifest = build_manifest(state.configuration, items, done.values(), skipped, facts)
        state.finish(manifest, LAYOUTS[layout].splits(kept))
    seconds = time.monotonic() - begun
    splits = {split: len(names) for split, names in manifest["splits"].items()}
    unlisted = manifest["not_in_split_file"]["names"]
    return GenerationReport(len(kept), sorted(skipped), seconds, images / seconds, reused, splits, unlisted)


def _check(rig: str, channels: Sequence[str], engine: str, layout: str) -> None:
    for name, value, known in (("rig", rig, RIGS), ("engine", engine, ENGINES), ("layout", layout, tuple(LAYOUTS))):
        if value not in known:
            raise ValueError(f"{name}: expected one of {', '.join(known)}, got {value!r}")
    unknown = set(channels) - {"rgba", *EXTRA_CHANNELS}
    if unknown or "rgba" not in channels:
        raise ValueError(f"channels: expected rgba and any of {', '.join(EXTRA_CHANNELS)}, got {tuple(channels)}")
    if layout != "native" and len(channels) > 1:
        raise ValueError(f"channels: expected rgba alone in the {layout} layout, got {tuple(channels)}")


def _sizes(rig: str, layout: str, views: int | None, resolution: int | None) -> tuple[int, int]:
    """How many pictures of how many pixels a side, by who has a say: the caller, the layout, the preset."""
    wanted, preset = LAYOUTS[layout].resolution, RIG_PRESETS.get(rig)
    if resolution is None:
        resolution = wanted or (preset.resolution if preset else RESOLUTION)
    elif wanted is not None and resolution != wanted:
        raise ValueError(f"resolution: the {layout} layout's loaders take {wanted} for granted, got {resolution}")
    if views is None:
        views = preset.views if preset else VIEWS
    return views, resolution


def _refuse_absurd(views: int, resolution: int, supersample: int, channels: Sequence[str]) -> None:
    """Sizes are checked before anything is allocated; the pictures of one object are in memory at once."""
    if views > MOST_VIEWS:
        raise ValueError(f"views: expected at most {MOST_VIEWS:,} an object, got {views:,}")
    if resolution * supersample > MOST_SAMPLES:
        raise ValueError(
            f"resolution: expected at most {MOST_SAMPLES:,} samples along a side, got {resolution:,} pixels of "
            f"{supersample} each"
        )
    pixel = 4 + sum({"depth": 4, "normals": 12, "coordinates": 12}.get(channel, 0) for channel in channels)
    needed = views * resolution**2 * pixel
    if needed > MOST_BYTES:
        raise ValueError(
            f"resolution: expected at most {MOST_BYTES >> 30} GiB of pictures an object, got {needed / 2**30:,.1f} GiB "
            f"({views:,} views of {resolution:,} x {resolution:,} pixels); take fewer of either"
        )


def _settings(source: Source, arguments: dict[str, Any]) -> dict[str, Any]:
    """What a worker needs to know, JSON-able."""
    from data_gen.rendering.renderers import find_renderer

    layout = LAYOUTS[arguments["layout"]]
    settings = {
        name: arguments[name]
        for name in ("rig", "views", "resolution", "lighting", "layout", "seed", "supersample", "field_of_view")
    }
    preset = RIG_PRESETS.get(arguments["rig"])
    distance = arguments["distance"]
    if distance is None:
        distance = preset.distance if preset and arguments["layout"] == "native" else layout.distance
    settings["distance"] = float(distance)
    if preset and arguments["field_of_view"] is None:
        settings["field_of_view"] = preset.field_of_view
    settings["field_of_view"] = layout.field_of_view or settings["field_of_view"]
    settings["channels"] = ["rgba", *sorted(set(arguments["channels"]) - {"rgba"})]
    settings["up"] = source.up if isinstance(source, MeshFolder) else "y"
    settings["renderer"] = find_renderer(arguments["renderer"]).name
    rig_of(settings, "")  # numbers that make no sense show here, not in every worker
    return settings


def _configuration(
    source: Source, items: list[Item], settings: dict[str, Any], held_out: float | int | None
) -> dict[str, Any]:
    """What decides the bytes, without a path of this machine."""
    configuration = {key: value for key, value in settings.items() if key != "out"}
    if isinstance(source, Procedural):
        described = asdict(source)
    else:
        names = [[item.name, item.split] for item in items]
        described = {
            "folder": Path(source.path).resolve().name,
            "meshes": len(items),
            "names": sha256(repr(names).encode()),
        }
    generator = f"hyperplanes {version('hyperplanes')}, pictures {PICTURES}"
    return configuration | {"generator": generator, "source": described, "held_out": held_out}


def _without_path(reason: str, source: Source) -> str:
    """A reason in which mesh files are named from their folder on, so that no path of this machine is written."""
    if isinstance(source, Procedural):
        return reason
    folder = Path(source.path)
    for written in (folder, folder.resolve()):
        reason = reason.replace(f"{written}/", "")
    return reason


def _facts(settings: dict[str, Any]) -> dict[str, Any]:
    """What readers of the data set want to know of all its objects."""
    layout = LAYOUTS[settings["layout"]]
    rig = rig_of(settings, "")
    return {
        "layout": settings["layout"],
        "renderer": settings["renderer"],
        "scene_sphere": {"centre": [0.0, 0.0, 0.0], "radius": OBJECT_RADIUS * layout.scale},
        "near": rig.near * layout.scale,
        "far": rig.far * layout.scale,
    }


def _outcomes(
    engine: str,
    settings: dict[str, Any],
    items: Iterator[dict[str, Any]],
    workers: int | None,
    timeout: float,
    recycle: int,
) -> Generator[Outcome, None, None]:
    if engine == "ray":
        from data_gen.datasets.ray_cluster import run_on_ray

        return run_on_ray(TARGET, settings, items, workers=workers, timeout=timeout, recycle=recycle)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = cores if workers is None else workers
    return run_isolated(TARGET, settings, items, workers=count, timeout=timeout, recycle=recycle)
