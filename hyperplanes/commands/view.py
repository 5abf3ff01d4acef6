"""Show an object in the browser: it can be turned, and the photographs are at the poses where they were taken.

A model adapts to the posed images. The page shows its field at once, again after every few fine-tuning steps, and at
the end as baked voxels, which turn without delay. If --checkpoint is a file that `bake` wrote, the page shows its
voxels. Ctrl-C ends the command.

Example:
    hyperplanes view example-car
    hyperplanes view scene --steps 100
    hyperplanes view scene --checkpoint chair.safetensors
    hyperplanes view scene --refine-poses
    hyperplanes view scene --learn-background
    hyperplanes view scene --compare hull_blend scratch_100
"""

from __future__ import annotations

import queue
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import tyro

from hyperplanes.commands.inputs.fields import bake_field, load_source, refuse_of_baked
from hyperplanes.commands.inputs.scene import prepare_task, read_scene
from hyperplanes.commands.options import POSED_IMAGES, ViewsArguments
from hyperplanes.commands.output.console import Console
from hyperplanes.utilities.machine.interrupts import Terminated
from hyperplanes.utilities.messages.errors import did_you_mean, prefix_errors
from hyperplanes.utilities.messages.formatting import counted

if TYPE_CHECKING:
    import torch

    from hyperplanes.adaptation.base import AdaptedField, Adapter
    from hyperplanes.adaptation.context import SupportContext
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.export.live import LiveViewer
    from hyperplanes.views import Views

__all__ = ["Arguments", "run"]

EVERY = 5  # fine-tuning steps between two pictures

ALWAYS_SHOWN, OF_A_MODEL = ("hull_blend", "nearest_view"), ("hyperplanes", "hyperplanes_100", "scratch_100")
"""Methods to compare with that need no checkpoint, and those that need that of the model."""


@dataclass(frozen=True)
class Arguments(ViewsArguments):
    """The options of `view`.

    Attributes:
        views: The posed images of the object. example-car comes with the package.
        checkpoint: The model that adapts to them, or a file that `bake` wrote, which is shown unchanged.
        steps: Fine-tuning steps on the views.
        fit: Gradient steps that fit the baked voxels to the views. With 0, the field is shown and no voxels are baked.
        compare: Methods of `hyperplanes evaluate` to show beside the model, on the right half of the page, such as
            hull_blend, nearest_view, hyperplanes (the model without gradient steps), or scratch_100.
        port: The port of the page on this machine.
    """

    views: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIEWS"), POSED_IMAGES]
    checkpoint: Path = Path("small")
    steps: Annotated[int, range(100_000)] = 0
    fit: Annotated[int, range(10_000)] = 100
    compare: tuple[str, ...] = ()
    port: Annotated[int, range(65_536)] = 8080


def run(arguments: Arguments) -> int:
    """Serve the page until Ctrl-C."""
    from hyperplanes.commands.inputs.object_record import warn_of_other_object
    from hyperplanes.data.devices import choose_device
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.export.live import LiveViewer, require_viewer

    require_viewer()
    warnings.filterwarnings(
        "ignore", "Queued a .* on a closed connection", UserWarning
    )  # a warning of viser if a browser closed the page
    console, device = Console(), choose_device(arguments.device)
    source = load_source(arguments.checkpoint, device, reflections=not arguments.no_reflections)
    given = {
        "--steps": arguments.steps != 0,
        "--learn-background": arguments.learn_background,
        "--refine-poses": arguments.refine_poses,
        "--no-reflections": arguments.no_reflections and not arguments.compare,
        "--fit": arguments.fit != Arguments.fit and not arguments.compare,
    }
    refuse_of_baked(source, given)
    others = _others(arguments, device)
    task, _ = read_scene(arguments.views, console, all_views=True, up=arguments.up, downscale=arguments.downscale)
    if not arguments.learn_background:
        warn_of_other_object(arguments.checkpoint, task.support, console)
    shown = prepare_task(arguments, task, source, console, all_views=True).support.to(device)
    wanted: queue.SimpleQueue[int] = queue.SimpleQueue()
    baked = isinstance(source, BakedScene)
    viewer = LiveViewer(shown, arguments.port, None if baked else wanted.put, list(others))
    if arguments.port not in (0, urlsplit(viewer.address).port):
        console.warn(f"--port: {arguments.port} is in use; the next free port is taken")
    console.say(f"{viewer.address}: open it in a browser; Ctrl-C ends it")
    try:
        if isinstance(source, BakedScene):
            viewer.show(source, f"{len(source.field.values):,} baked voxels")
            _show_others(others, shown, viewer, wanted, console)
            wanted.get()  # until Ctrl-C
            return 0
        number = len(shown)
        while True:
            for name in others:  # its current field is of another number of views
                viewer.show_other(name, None, f"{name}: not adapted yet")
            with suppress(_Superseded):
                _adapt(source, shown[:number], arguments, viewer, wanted, console)
                _show_others(others, shown[:number], viewer, wanted, console)
            number = wanted.get()
            while not wanted.empty():
                number = wanted.get()
    except Terminated as end:
        raise type(end)("the page is closed") from end
    except KeyboardInterrupt:
        console.say("ended")
    finally:
        viewer.stop()
    return 0


def _others(arguments: Arguments, device: torch.device) -> dict[str, Adapter]:
    """The methods to compare with, by name."""
    from hyperplanes.adaptation.checkpoints import find_checkpoint, find_checkpoints
    from hyperplanes.methods import Request, is_method, make_method

    if not arguments.compare:
        return {}
    model = arguments.checkpoint
    checkpoints = {} if model.is_file() else find_checkpoints([model]) | {"hyperplanes": find_checkpoint(model)}
    reflections = not arguments.no_reflections
    usual = [*ALWAYS_SHOWN, *(OF_A_MODEL if checkpoints else ())]
    made = {}
    for name in arguments.compare:
        if not is_method(name):
            near = did_you_mean(name, usual)
            raise ValueError(f"--compare: expected a method such as {', '.join(usual)}, got {name!r}{near}")
        with prefix_errors("--compare"):
            made[name] = make_method(Request(name, checkpoints, device=device, reflections=reflections))
    return made


class _Superseded(Exception):
    """Another number of views was requested on the page."""


def _check(wanted: queue.SimpleQueue[int]) -> None:
    """Raise `_Superseded` if another number of views was requested, to end the work on the current number."""
    if not wanted.empty():
        raise _Superseded


def _show_others(
    others: Mapping[str, Adapter], shown: Views, viewer: LiveViewer, wanted: queue.SimpleQueue[int], console: Console
) -> None:
    """Show the other methods one after the other.

    If a method cannot adapt to this number of views, the page and the terminal show the reason.
    """
    for name, adapter in others.items():
        _check(wanted)
        console.say(f"adapting {name}")
        try:
            viewer.show_other(name, adapter.adapt(shown))
        except ValueError as error:
            console.warn(f"{name}: {error}")
            viewer.show_other(name, None, f"{name}: {error}")


def _fields(
    model: HyperPlanes, context: SupportContext, views: Views, steps: int
) -> Iterator[tuple[int, AdaptedField | None]]:
    """The number of steps done, after each step, with the field if it is to be shown after this step."""
    import torch

    from hyperplanes.adaptation.correction.stacking import tuned_field
    from hyperplanes.adaptation.fine_tuning import average_of, make_descent
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.parameters import Parameters

    if not steps:
        yield 0, model.adapt_to(context)
        return
    descent = make_descent(model, context, FineTuning(), views)
    average = average_of(model, context, FineTuning(), descent)
    for done in descent.run(steps):
        if done % EVERY and done != steps:
            yield done, None
            continue
        with torch.no_grad():
            weights = Parameters((name, value.clone()) for name, value in descent.weights().items())
        yield done, tuned_field(model, context, weights, *average)


def _adapt(
    model: HyperPlanes,
    shown: Views,
    arguments: Arguments,
    viewer: LiveViewer,
    wanted: queue.SimpleQueue[int],
    console: Console,
) -> None:
    """Show the field when it is adapted, while it is fine-tuned, and when it is baked."""
    from hyperplanes.adaptation.alignment.canonical_frame import to_canonical_frame
    from hyperplanes.adaptation.context import trained_on
    from hyperplanes.export.baking import BakedScene, default_side

    console.say(f"adapting to {counted(len(shown), 'view')}")
    model = model.without_residuals()  # correction would take too long for an interactive page
    placed, steps = to_canonical_frame(model, shown), arguments.steps if len(shown) > 1 else 0
    context, field = placed.context(model), None
    for done, made in _fields(model, context, trained_on(context, placed.views), steps):
        if made is not None:
            field = placed.in_scene(made)
            viewer.show(field, f"{len(shown)} support views, {done} of {steps} fine-tuning steps")
        _check(wanted)
    if arguments.fit and field is not None:
        side, check = default_side(shown.size), partial(_check, wanted)
        baked = bake_field(field, shown, side, fit=arguments.fit, console=console, check=check)
        viewer.show(
            BakedScene(baked),
            f"{counted(len(shown), 'support view')}, {counted(steps, 'step')}, {len(baked.values):,} baked voxels",
        )
