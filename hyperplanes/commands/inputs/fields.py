"""Makes the field that a verb renders: a model adapts it to the views, or it is read from a baked file."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hyperplanes.commands.output.writing import keep_if_possible
from hyperplanes.utilities.messages.formatting import counted, format_duration

if TYPE_CHECKING:
    import torch
    from kornia.geometry.camera import PinholeCamera

    from hyperplanes.adaptation.base import AdaptedField, Pictures, Renderable
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.commands.output.console import Bar, Console
    from hyperplanes.configuration.fine_tuning import FineTuning, Steps
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.fields.baked import BakedField
    from hyperplanes.rendering.renderer import Sampler
    from hyperplanes.views import Views

__all__ = ["adapt_to", "bake_field", "load_adaptable", "load_source", "refuse_baked", "refuse_of_baked", "render_views"]


WORTH_KEEPING = 5.0  # seconds of adapting above which the field is kept on the disk


def load_source(path: Path, device: torch.device, *, reflections: bool = True) -> HyperPlanes | BakedScene:
    """The model of a checkpoint, or the scene of a file that `bake` wrote.

    Args:
        path: a folder, the name of a packaged model, or a baked file.
        device: the device of the model; a baked scene is rendered on the CPU.
        reflections: as in `load_adaptable`.
    """
    if path.is_file():
        from hyperplanes.export.baking import BakedScene
        from hyperplanes.fields.baked import BakedField

        return BakedScene(BakedField.load(path))
    return load_adaptable(path, device, reflections=reflections)


def load_adaptable(path: Path, device: torch.device, *, reflections: bool = True) -> HyperPlanes:
    """The model of a checkpoint.

    Args:
        path: a folder, or the name of a packaged model.
        device: the device of the model.
        reflections: whether the model may also use reflections of the views of a symmetric object.
    """
    from hyperplanes.adaptation.checkpoints import find_checkpoint
    from hyperplanes.adaptation.hyperplanes import HyperPlanes

    model = HyperPlanes.from_pretrained(find_checkpoint(path)).to(device)
    return model if reflections else model.without_reflections()


def refuse_baked(path: Path, verb: str) -> None:
    """Refuse a baked file for a verb that needs a model.

    Raises:
        ValueError: `path` is a file.
    """
    if path.is_file():
        raise ValueError(
            f"{path}: expected a checkpoint's folder to {verb} with, got a file; a baked file holds one finished "
            "object, which `render`, `export` and `inspect` take"
        )


def refuse_of_baked(source: HyperPlanes | BakedScene, given: Mapping[str, bool]) -> None:
    """Refuse options for adapting, sampling and baking if the source is a baked file, which needs none of these.

    Args:
        source: the result of `load_source`.
        given: by the name of each such option, whether it was given.

    Raises:
        ValueError: the source is a baked file, and such an option was given.
    """
    from hyperplanes.export.baking import BakedScene

    found = [name for name, is_given in given.items() if is_given]
    if found and isinstance(source, BakedScene):
        raise ValueError(f"{found[0]}: expected none with a baked file, which is finished; leave it out")


def adapt_to(
    source: HyperPlanes | BakedScene,
    shown: Views,
    name: str,
    console: Console,
    *,
    steps: Steps = 0,
    settings: FineTuning | None = None,
) -> tuple[AdaptedField | BakedScene, Sequence[str]]:
    """The field of one object. It prints how the field was made, and warns if its pictures may be bad.

    Args:
        source: a model, or a baked scene, which is returned as it is.
        shown: the support views of the object.
        name: the name of the object.
        console: prints the messages.
        steps: as in `HyperPlanes.fine_tune`.
        settings: as in `HyperPlanes.fine_tune`.

    Returns:
        The field, and the warnings.
    """
    from hyperplanes.adaptation.alignment.rotation import RotatedField
    from hyperplanes.adaptation.base import no_masks_warning
    from hyperplanes.adaptation.correction.stacking import AveragedField, StackedField
    from hyperplanes.commands.inputs.disk_cache import keep_field, kept_folder, recall_field
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.evaluation.suitability import suitability_warnings
    from hyperplanes.export.baking import BakedScene

    if isinstance(source, BakedScene):
        console.say(f"{len(source.field.values):,} baked voxels, rendered from the poses of {name}")
        return source, []
    warned = suitability_warnings(source, shown, steps)
    for line in warned:
        console.warn(f"{name}: {line}")
    started, taken, settings = time.perf_counter(), [], settings or FineTuning()
    folder = kept_folder(source, shown, steps, settings)
    kept = recall_field(folder, shown, shown.images.device)
    if kept is not None:
        console.say(f"{name}: adapted to the same views before; read from {folder}")
        return kept, warned
    with console.bar("fine-tuning") as bar, no_masks_warning():

        def count(done: int) -> None:
            taken.append(done)
            if steps == "auto":
                bar.show(done, settings.max_steps, "steps at most")
            elif steps:
                bar.show(done, steps, "steps")

        def count_trials(done: int) -> None:
            bar.show(done, settings.max_steps, "steps at most, to find the best number")

        field = source.fine_tune(shown, steps, settings, on_step=count, on_trial=count_trials)
    if time.perf_counter() - started > WORTH_KEEPING:
        keep_if_possible(folder, lambda: keep_field(source, field, folder), console)
    how = f", {taken[-1]} fine-tuning steps" if any(taken) else ""
    if field.symmetry is not None:
        planes = field.symmetry.order
        how += ", together with their reflections" + (f" about {planes} planes" if planes > 1 else "")
    rendered = field.without_residuals()
    if isinstance(rendered, RotatedField):
        how += ", rotated into its canonical frame"
        rendered = rendered.unrotated
    if isinstance(rendered, StackedField):
        beside = "the field before gradient steps" if isinstance(rendered, AveragedField) else "hull_blend"
        how += f", averaged with {beside}"
    seconds = format_duration(time.perf_counter() - started)
    console.say(f"adapted to {counted(len(shown), 'view')} of {name} in {seconds}{how}")
    return field, warned


def render_views(
    field: Renderable, cameras: PinholeCamera, console: Console, sampling: Sampler | None = None
) -> Pictures:
    """The pictures of cameras, rendered one after the other, with a progress line.

    Args:
        field: the field to render.
        cameras: any number of cameras.
        console: shows the progress.
        sampling: the sampler of an adapted field; by default the field's own.
    """
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.rendering.images import join_pictures

    if sampling is not None and isinstance(field, AdaptedField):
        field = field.with_sampling(sampling)
    parts = []
    with console.bar("rendering") as bar:
        for view in range(cameras.batch_size):
            parts.append(field.render(camera.select(cameras, [view])))
            bar.show(view + 1, cameras.batch_size, "views")
    return join_pictures(parts)


def bake_field(
    field: AdaptedField,
    shown: Views,
    side: int,
    *,
    fit: int,
    console: Console,
    check: Callable[[], None] = lambda: None,
) -> BakedField:
    """The voxels of a field, fitted to the views that it was adapted to, with progress lines.

    Args:
        field: the field to bake.
        shown: its support views.
        side: voxels along each axis.
        fit: gradient steps on the views; 0 keeps the field's own colours and densities.
        console: shows the progress, and at the end the number of voxels and the time.
        check: called after each part of the work; it may raise to end the work.
    """
    from hyperplanes.export.baking import bake
    from hyperplanes.export.voxel_fitting import fit_voxels, render_guide

    def show(bar: Bar, done: int, total: int, text: str) -> None:
        check()
        bar.show(done, total, text)

    started = time.perf_counter()
    with console.bar("baking") as bar:
        baked = bake(field, side=side, on_part=lambda done, total: show(bar, done, total, "voxels"))
    between = time.perf_counter()
    how = f"{len(baked.values):,} voxels of {side}^3 baked in {format_duration(between - started)}"
    if fit:
        with console.bar("fitting voxels") as bar:
            guide = render_guide(field, shown)
            baked = fit_voxels(baked, shown, guide=guide, steps=fit, on_step=lambda done: show(bar, done, fit, "steps"))
        how += f", fitted to {counted(len(shown), 'view')} in {format_duration(time.perf_counter() - between)}"
    console.say(how)
    return baked
