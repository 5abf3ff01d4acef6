"""Render one object and write its files: what a worker process does, again and again."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_gen.datasets.layouts import LAYOUTS, RenderedObject
from data_gen.datasets.sources import Item, seed_of
from data_gen.rigs import Rig, make_rig
from hyperplanes.data.files import encode_json, sha256, write_folder, write_whole

__all__ = ["open_renderer", "rig_of"]


def rig_of(settings: dict[str, Any], name: str) -> Rig:
    """The cameras of one object.

    Args:
        settings: rig, views, resolution, seed, distance and field_of_view (degrees or None).
        name: of the object, on which random rigs depend.

    Returns:
        The rig.
    """
    numbers = {key: settings[key] for key in ("views", "resolution", "distance", "field_of_view")}
    return make_rig(settings["rig"], **numbers, seed=seed_of(settings["seed"], "rig", name) % 2**32)


@contextmanager
def open_renderer(settings: dict[str, Any]) -> Generator[Callable[[dict[str, Any]], dict[str, Any]], None, None]:
    """A function from an `Item`'s fields to the record of the object it wrote; one renderer serves all calls.

    Args:
        settings: the arguments of `data_gen.datasets.generate.generate` as JSON, with `out`, `renderer`, `distance`,
            `field_of_view`, `up` and `supersample`.

    Yields:
        The function. It raises ValueError, with the reason, for an object that cannot be drawn.
    """
    from data_gen.rendering.mesh_renderer import MeshRenderer

    with MeshRenderer(settings["renderer"], settings["supersample"]) as renderer:
        yield lambda fields: _write(_draw(renderer, Item(**fields), settings), settings)


def _draw(renderer: Any, item: Item, settings: dict[str, Any]) -> RenderedObject:
    from data_gen.meshes.mesh import load_mesh, prepare_scene, render_ready

    if item.path is not None:
        mesh = load_mesh(item.path, up=settings["up"], name=item.name)
    else:
        from data_gen.shapes import make

        mesh = prepare_scene(make(str(item.class_name), int(item.seed or 0)), item.name, closed=True)
    rig = rig_of(settings, item.name)
    channels = [channel for channel in settings["channels"] if channel != "mesh"]
    rendering = renderer.render(
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
