"""Render one object and write its files: the work of a worker process."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from data_gen.datasets.config import GenerationConfig
from data_gen.datasets.layouts import LAYOUTS, RenderedObject
from data_gen.datasets.sources import Item
from hyperplanes.utilities.files.encoding import encode_json, sha256
from hyperplanes.utilities.files.reading import PROGRESS_FOLDER
from hyperplanes.utilities.files.writing import write_folder, write_whole

__all__ = ["open_renderer"]


def open_renderer(settings: dict[str, Any]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """A function from an `Item`'s fields to the record of the object it wrote; one renderer serves all calls.

    Args:
        settings: `out`, the folder of the data set, `render`, a resolved `GenerationConfig` as JSON, and `meshes`, the
            folder that meshes may not read outside of, or None.

    Returns:
        The function. It raises ValueError, with the reason, for an object that cannot be drawn.
    """
    from data_gen.rendering.mesh_renderer import MeshRenderer

    config, out = GenerationConfig.from_json(settings["render"]), Path(settings["out"])
    meshes = None if settings["meshes"] is None else Path(settings["meshes"])
    renderer = MeshRenderer(config.renderer, config.supersample)

    def process(fields: dict[str, Any]) -> dict[str, Any]:
        rendered = _render(renderer, Item(**fields), config, meshes)
        return _write(rendered, LAYOUTS[config.layout].files(rendered), out)

    return process


def _render(renderer: Any, item: Item, config: GenerationConfig, meshes: Path | None) -> RenderedObject:
    from data_gen.meshes.formats.gltf import write_glb
    from data_gen.meshes.mesh import load_mesh, mesh_parts, prepare_scene

    if item.path is not None:
        mesh = load_mesh(item.path, up=item.up, name=item.name, within=meshes)
    else:
        from data_gen.shapes import ONE_SIDED, make

        scene = make(str(item.class_name), int(item.seed or 0))
        mesh = prepare_scene(scene, item.name, closed=item.class_name in ONE_SIDED)
    rig = config.make_rig(item.name, item.class_name)
    channels = [channel for channel in config.channels if channel != "mesh"]
    rendering = renderer.render(
        mesh_parts(mesh),
        rig,
        lighting=config.lighting,
        channels=channels,
        name=item.name,
        seed=config.seed_for("lighting", item.name),
    )
    extra = {channel: getattr(rendering, channel) for channel in channels if channel != "rgba"}
    model: Any = None
    if "mesh" in config.channels:
        model = write_glb(mesh.scene)
    return RenderedObject(item, rig, rendering.rgba, extra, model, mesh)


def _write(rendered: RenderedObject, files: dict[str, bytes], out: Path) -> dict[str, Any]:
    """Write an object's files, then the record that they are complete."""
    scratch = out / PROGRESS_FOLDER / "unfinished"
    if len(files) > 1:
        folder = os.path.commonpath(files)
        write_folder(out / folder, {os.path.relpath(path, folder): data for path, data in files.items()}, scratch)
    else:
        for path, data in files.items():
            write_whole(out / path, data, scratch, durable=False)
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
    if item.source is not None:
        record["source"] = item.source
    if mesh.warnings:
        record["warnings"] = list(mesh.warnings)
    if mesh.made_of:
        record["made_of"] = mesh.made_of
    if mesh.lost_files:
        record["lost_files"] = list(mesh.lost_files)
    checksums = {path: sha256(data) for path, data in files.items()}
    done = {"name": item.name, "record": record, "files": checksums}
    write_whole(out / PROGRESS_FOLDER / "done" / f"{item.name}.json", encode_json(done), scratch, durable=False)
    return done
