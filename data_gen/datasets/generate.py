"""Generate a data set: objects stream through worker processes into files; interrupted, it resumes."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_gen.datasets.config import GenerationConfig
from data_gen.datasets.layouts import LAYOUTS, check_names
from data_gen.datasets.manifest import Entry, GenerationState, build_manifest, holds_data_set
from data_gen.datasets.sources import Item, MeshFolder, Procedural, Source, check_source, list_items
from data_gen.datasets.workers import Outcome, WorkerError, run_isolated
from data_gen.rigs import OBJECT_RADIUS
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.machine.environment import usable_cores

__all__ = ["GenerationConfig", "GenerationReport", "MeshFolder", "Procedural", "check", "generate"]

PICTURES = 5
"""Version of the pictures, increased whenever the same arguments give other bytes, so that none are mixed."""

TARGET = "data_gen.datasets.objects:open_renderer"


@dataclass(frozen=True)
class GenerationReport:
    """The outcome of a generation.

    Attributes:
        written: objects in the data set, including those of an earlier, interrupted call.
        skipped: names and reasons of objects that are not in it.
        seconds: duration of this call.
        images_per_second: images written per second by this call.
        reused: objects that an earlier call had written.
        splits: number of objects in each split.
        requested: number of objects that each split should have; at least one for testing if any were to be held out.
        unlisted: objects that the split file does not name, which are trained on.
        incomplete: objects drawn without a texture or another file that they name.
        warned: objects with warnings, including those with lost files.
        changed: objects that an earlier call had written from other files.
        duplicates: mesh files of the same objects in other formats, not included in `skipped`.
    """

    written: int
    skipped: list[tuple[str, str]]
    seconds: float
    images_per_second: float
    reused: int
    splits: dict[str, int]
    requested: dict[str, int]
    unlisted: list[str]
    incomplete: list[str]
    warned: list[str]
    changed: list[str]
    duplicates: list[str]


def check(source: Source, config: GenerationConfig) -> None:
    """Refuse names and numbers that are wrong whatever the files and the renderer are, which take longer to find.

    An unknown name, or a number that makes no sense, is a ValueError.

    Args:
        source: as in `generate`.
        config: as in `generate`.
    """
    check_source(source, config.held_out)
    render = config.resolve_except_renderer()
    if isinstance(source, Procedural):
        render.check_class(source.class_name)


def generate(
    source: Source,
    out: str | Path,
    config: GenerationConfig | None = None,
    *,
    progress: Callable[[int, int, str], None] | None = None,
) -> GenerationReport:
    """Render objects into a data set.

    The same arguments give the same bytes, regardless of interruptions and the number of workers. Objects of an earlier
    call are kept, except for meshes whose files have changed, appeared or disappeared since. An object that cannot be
    drawn, takes too long, or whose worker crashes twice, is skipped and listed, as are meshes of unsupported formats;
    the others are not affected.

    Args:
        source: procedural objects or mesh files.
        out: the folder; new, empty, or with the same generation, interrupted or finished.
        config: how they are rendered; the defaults of `GenerationConfig` when None.
        progress: called with (objects done, objects in all, name) after each object.

    Returns:
        What was written and what was skipped.

    Raises:
        ValueError: an argument that makes no sense, a renderer that does not work, no object that could be drawn; as
            DataError, a folder that holds something else, or a full disk.
    """
    begun = time.monotonic()
    out, config = Path(out), config or GenerationConfig()
    check(source, config)
    render = config.resolve()
    listing = list_items(source, config.held_out, partial(_reason_against, out))
    items = listing.items
    classes = sorted({item.class_name for item in items}, key=str)
    for class_name in classes:
        render.check_class(class_name)
    check_names(render.layout, [item.name for item in items])
    meshes = str(source.path) if isinstance(source, MeshFolder) else None
    with GenerationState(out, _configuration(source, items, render, config.held_out)) as state:
        done = state.done()
        listed = [item for item in items if item.name in done]
        changed = {item.name: done.pop(item.name) for item in listed if _has_changed(item, done[item.name], meshes)}
        reused = len(listed) - len(changed)
        pending = (asdict(item) for item in items if item.name not in done)
        settings = {"out": str(out.resolve()), "render": render.as_json(), "meshes": meshes}
        skipped, images = [], 0
        with closing(_outcomes(config, settings, pending)) as outcomes:
            for count, outcome in enumerate(outcomes, reused + 1):
                name = outcome.item["name"]
                if outcome.result is None:
                    skipped.append((name, _without_path(str(outcome.reason), source)))
                    if name in changed:
                        state.remove(changed[name])
                else:
                    done[name] = outcome.result
                    images += outcome.result["record"]["views"]
                if progress is not None:
                    progress(count, len(items), name)
        kept = [item for item in items if item.name in done]
        if not kept:
            name, reason = skipped[0]
            raise ValueError(f"{out}: none of {len(items)} objects could be drawn; {name}: {reason}")
        skipped += listing.unreadable
        left_out = skipped + listing.duplicates
        manifest = build_manifest(state.configuration, items, done.values(), left_out, _facts(render, classes))
        state.finish(manifest, LAYOUTS[render.layout].splits(kept))
    seconds = time.monotonic() - begun
    splits = {split: len(names) for split, names in manifest["splits"].items()}
    requested = {split: sum(item.split == split for item in items) for split in splits}
    requested["test"] = max(requested["test"], int(bool(config.held_out)))
    unlisted, incomplete, warned = (
        manifest[key]["names"] for key in ("not_in_split_file", "with_lost_files", "with_warnings")
    )
    return GenerationReport(
        written=len(kept),
        skipped=sorted(skipped),
        seconds=seconds,
        images_per_second=images / seconds,
        reused=reused,
        splits=splits,
        requested=requested,
        unlisted=unlisted,
        incomplete=incomplete,
        warned=warned,
        changed=list(changed),
        duplicates=[name for name, _ in listing.duplicates],
    )


def _reason_against(out: Path, folder: Path) -> str | None:
    """Why a folder is not searched for meshes: a reason for the user, "" for the folder of this data set, or None."""
    if out.exists() and folder.samefile(out):
        return ""
    written = holds_data_set(folder)
    return "expected meshes, found a data set of hyperplanes generate; give its folder alone" if written else None


def _configuration(
    source: Source, items: list[Item], render: GenerationConfig, held_out: float | int | None
) -> dict[str, Any]:
    """Everything that affects the bytes, without paths of this machine."""
    if isinstance(source, Procedural):
        described = asdict(source)
    else:
        described = {
            "folder": Path(source.path).resolve().name,
            "meshes": len(items),
            "up": source.up,
            "up_of": list(source.up_of),
            "class_name": source.class_name,
            "splits": {item.name: item.split for item in items},
        }
    generator = f"hyperplanes {version('hyperplanes')}, pictures {PICTURES}"
    return render.as_json() | {"generator": generator, "source": described, "held_out": held_out}


def _has_changed(item: Item, entry: Entry, meshes: str | None) -> bool:
    """Whether a mesh's files, or their place, differ from those that it was drawn from."""
    if item.path is None or meshes is None:
        return False
    from data_gen.meshes.model_folder import model_checksums

    made_of, place = entry["record"]["made_of"], entry["record"]["source"]
    return made_of != model_checksums(Path(item.path), made_of, Path(meshes)) or place != item.source


def _without_path(reason: str, source: Source) -> str:
    """A reason with mesh files named relative to their folder, so that no path of this machine is written."""
    if isinstance(source, Procedural):
        return reason
    folder = Path(source.path)
    for written in (folder, folder.resolve()):
        reason = reason.removeprefix(f"{written}/")
    return reason


def _facts(render: GenerationConfig, classes: list[str | None]) -> dict[str, Any]:
    """Facts about all objects for readers of the data set."""
    scale, rigs = LAYOUTS[render.layout].scale, [render.make_rig("", name) for name in classes]
    return {
        "layout": render.layout,
        "renderer": render.renderer,
        "scene_sphere": {"centre": [0.0, 0.0, 0.0], "radius": OBJECT_RADIUS * scale},
        "near": min(rig.near for rig in rigs) * scale,
        "far": max(rig.far for rig in rigs) * scale,
    }


def _outcomes(
    config: GenerationConfig, settings: dict[str, Any], items: Iterator[dict[str, Any]]
) -> Generator[Outcome, None, None]:
    """What the workers make of the items, in order of completion; DataError if they can process none."""
    limits = {"timeout": config.timeout, "recycle": config.recycle}
    try:
        if config.engine == "ray":
            from data_gen.datasets.ray_cluster import run_on_ray

            yield from run_on_ray(TARGET, settings, items, workers=config.workers, **limits)
        else:
            workers = usable_cores() if config.workers is None else config.workers
            yield from run_isolated(TARGET, settings, items, workers=workers, **limits)
    except WorkerError as error:
        raise DataError(str(error)) from error
