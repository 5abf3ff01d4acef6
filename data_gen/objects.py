"""Render one object and write its files: what a worker process does, again and again."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_gen.layouts import LAYOUTS, RenderedObject
from data_gen.rig import Rig
from data_gen.rig_presets import RIG_PRESETS
from data_gen.sources import Item, seed_of
from hyperplanes.data.files import encode_json, sha256, write_folder, write_whole

__all__ = ["RIGS", "make_rig", "open_renderer"]

RIGS = ("fixed", "random", "hemisphere", "orbit", *RIG_PRESETS)
"""Names of camera rigs."""


def make_rig(settings: dict[str, Any], name: str) -> Rig:
    """The cameras of one object.

    Args:
        settings: rig, views, resolution, seed, distance and field_of_view (degrees or None).
        name: of the object, on which random rigs depend.

    Returns:
        The rig.

    Raises:
        ValueError: an unknown rig, or numbers that make no sense.
    """
    from data_gen import rigs

    common = {"distance": settings["distance"], "field_of_view": settings["field_of_view"]}
    views, resolution = settings["views"], settings["resolution"]
    kind = settings["rig"]
    if kind in RIG_PRESETS:
        kind = RIG_PRESETS[kind].kind
    if kind == "fixed":
        return rigs.fixed(views, resolution, **common)
    if kind == "orbit":
        return rigs.orbit(views, resolution, **common)
    if kind not in RIGS:
        raise ValueError(f"rig: expected one of {', '.join(RIGS)}, got {kind!r}")
    lowest = -90.0 if kind == "random" else 0.0
    return rigs.random(views, resolution, seed=seed_of(settings["seed"], "rig", name) % 2**32, lowest=lowest, **common)


@contextmanager
def open_renderer(settings: dict[str, Any]) -> Generator[Callable[[dict[str, Any]], dict[str, Any]], None, None]:
    """A function from an `Item`'s fields to the record of the object it wrote; one renderer serves all calls.

    Args:
        settings: the arguments of `data_gen.dataset.generate` as JSON, with `out`, `renderer`, `distance`,
            `field_of_view`, `up` and `supersample`.

    Yields:
        The function. It raises ValueError, with the reason, for an object that cannot be drawn.
    """
    from data_gen.rasterise import Rasteriser

    with Rasteriser(settings["renderer"], settings["supersample"]) as rasteriser:
        yield lambda fields: _write(_draw(rasteriser, Item(**fields), settings), settings)


def _draw(rasteriser: Any, item: Item, settings: dict[str, Any]) -> RenderedObject:
    from data_gen.meshes import load_mesh, prepare_scene, render_ready

    if item.path is not None:
        mesh = load_mesh(item.path, up=settings["up"], name=item.name)
    else:
        from data_gen.shapes import make

        mesh = prepare_scene(make(str(item.class_name), int(item.seed or 0)), item.name, closed=True)
    rig = make_rig(settings, item.name)
    channels = [channel for channel in settings["channels"] if channel != "mesh"]
    rendering = rasteriser.render(
        render_ready(mesh),
        rig,
        lighting=settings["lighting"],
        channels=channels,
        name=item.name,
        seed=seed_of(settings["seed"], "lighting", item.name) % 2**32,
    )
    extra = {channel: getattr(rendering, channel) for channel in channels if channel != "rgba"}
    model: Any = mesh.scene.export(file_type="glb") if "mesh" in settings["channels"] else None
    return RenderedObject(item, rig, rendering.rgba, extra, model, mesh)


def _write(rendered: RenderedObject, settings: dict[str, Any]) -> dict[str, Any]:
    out = Path(settings["out"])
    scratch = out / ".progress" / "unfinished"
    files = LAYOUTS[settings["layout"]].files(rendered)
    checksums = {path: sha256(data) for path, data in files.items()}
    if len(files) > 1:
        folder = os.path.commonpath(files)
        write_folder(out / folder, {os.path.relpath(path, folder): data for path, data in files.items()}, scratch)
    else:
        for path, data in files.items():
            write_whole(out / path, data, scratch)
    item, mesh = rendered.item, rendered.mesh
    record: dict[str, Any] = {
        "class": item.class_name,
        "faces": mesh.face_count,
        "split": item.split,
        "views": len(rendered.rig),
        "world_from_file": mesh.world_from_file.tolist(),
    }
    if item.seed is not None:
        record["seed"] = item.seed
    if mesh.warnings:
        record["warnings"] = list(mesh.warnings)
    done = {"name": item.name, "record": record, "files": checksums}
    write_whole(out / ".progress" / "done" / f"{item.name}.json", encode_json(done), scratch)
    return done
