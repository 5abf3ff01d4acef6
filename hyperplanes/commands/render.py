"""New views of one object from a few posed images: the model adapts to them in one step, or some more with --steps.

The images come as a folder with transforms.json (Blender's, nerfstudio's), a COLMAP model, or an object of any data
set. The model is shown the support half of the views and asked for the other half, so that the result can be compared
with the truth; --orbit asks for a round about the object instead.

Example:
    hyperplanes render --checkpoint runs/demo --views photos/ --out new-views
    hyperplanes render --checkpoint runs/demo --views photos/ --out new-views --orbit 48 --all-views
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import Free, OptionalInt, Protocol, Steps, Up, optional
from hyperplanes.formatting import format_duration

if TYPE_CHECKING:
    from hyperplanes.views import Task

__all__ = ["Arguments", "after_steps", "read_scene", "run"]


@dataclass(frozen=True)
class Arguments:
    """What to look at, and from where.

    Attributes:
        checkpoint: What `train`, `adapt` or `demo` wrote.
        views: The posed images of the object.
        out: The folder for the pictures.
        steps: Fine-tuning steps on the shown views, or auto: as many as show left-out ones best. 0 is the paper's
            single forward pass.
        fine_tune: What fine-tuning optimises: theta + delta itself, or the hypernetwork with theta frozen.
        orbit: So many pictures evenly around the object, and a turntable, instead of the query poses.
        size: Pixels along the longer side of an orbit's pictures; as the images when not given.
        turntable: The format of the turntable.
        all_views: Show the model every view, not only the support half.
        up: The axis that points up in the world of the views: y as in training data, z as in Blender.
        protocol: How the field is sampled: as it was trained, 64 + 128 times a ray as in the paper, or fast.
        device: auto, cpu or cuda.
    """

    checkpoint: Path
    views: Path
    out: Path
    steps: Steps = 0
    fine_tune: Free = "weights"
    orbit: Annotated[int | None, optional("FRAMES")] = None
    size: OptionalInt = None
    turntable: Literal["webp", "gif"] = "webp"
    all_views: bool = False
    up: Up = "y"
    protocol: Protocol = "default"
    device: str = "auto"


def read_scene(path: Path, all_views: bool, up: str = "y") -> Task:
    """The views to show and the views to ask for; the same ones where all are shown.

    Args:
        path: of the posed images.
        all_views: whether all are shown.
        up: the axis that points up in their world; they are turned so that it is y.

    Returns:
        Views of a world with y up.
    """
    from hyperplanes.data import read_task, read_views
    from hyperplanes.data.upright import upright, upright_task
    from hyperplanes.views import Task

    if not all_views:
        return upright_task(read_task(path), up)
    views = upright(read_views(path), up)
    return Task(views, views, path.resolve().name)


def after_steps(taken: Sequence[int]) -> str:
    """How many fine-tuning steps were taken, as the end of a sentence; nothing where there were none to take."""
    return f", {taken[-1]} fine-tuning steps" if any(taken) else ""


def run(arguments: Arguments) -> int:
    """Adapt, render, write, and say how well it went where the truth is known."""
    from hyperplanes.files import one_writer

    with one_writer(arguments.out):
        return _run(arguments)


def _run(arguments: Arguments) -> int:
    from hyperplanes.adaptation.fine_tuning import FineTuning
    from hyperplanes.adaptation.pretrained import load_model
    from hyperplanes.devices import choose_device
    from hyperplanes.export import encode_animation, orbit_cameras, save_images, to_pixels
    from hyperplanes.files import write_whole
    from hyperplanes.metrics import psnr, ssim
    from hyperplanes.presets import PROTOCOLS

    console, device = Console(), choose_device(arguments.device)
    model = load_model(arguments.checkpoint).to(device)
    task = read_scene(arguments.views, arguments.all_views, arguments.up)
    shown, asked = task.support.to(device), task.query.to(device)
    started = time.perf_counter()
    settings, taken = FineTuning(free=arguments.fine_tune), []
    field = model.fine_tune(shown, arguments.steps, settings, on_step=taken.append)
    seconds = time.perf_counter() - started
    console.say(f"adapted to {len(shown)} views of {task.name} in {format_duration(seconds)}{after_steps(taken)}")
    cameras = asked.cameras
    if arguments.orbit is not None:
        cameras = orbit_cameras(shown, arguments.orbit, size=arguments.size)
    started = time.perf_counter()
    pictures = field.render(cameras, PROTOCOLS[arguments.protocol])
    seconds = (time.perf_counter() - started) / cameras.batch_size
    if arguments.orbit is None:
        paths = save_images(pictures.images, arguments.out, asked.names)
        images = pictures.images.clamp(0, 1)
        quality = f"{float(psnr(images, asked.images).mean()):.2f} dB PSNR"
        if min(asked.size) >= 11:
            quality += f", {float(ssim(images, asked.images).mean()):.3f} SSIM"
        known = "shown to the model as well" if arguments.all_views else "never shown to the model"
        console.say(f"against the {len(asked)} true views, {known}: {quality}")
    else:
        paths = save_images(pictures.images, arguments.out)
        animation = arguments.out / f"turntable.{arguments.turntable}"
        write_whole(animation, encode_animation(to_pixels(pictures.images), arguments.turntable))
        console.say(f"{animation}: the turntable")
    console.say(f"{arguments.out}: {len(paths)} pictures, {format_duration(seconds)} each")
    return 0
