"""New views of one object from a few posed images: the model adapts to them in one step, or some more with --steps.

The images come as a folder with transforms.json (Blender's, nerfstudio's), a COLMAP model, what Polycam, Record3D,
KIRI Engine, RealityCapture or Metashape export, a scene of LLFF, IDR or NSVF, or an object of any data set. The model
is shown the support half of the views and asked for the other half, so that the result can be compared with the truth;
--orbit asks for a round about the object instead.

Example:
    hyperplanes render --checkpoint small --views example-car --out new-views
    hyperplanes render --checkpoint runs/demo --views photos/ --out new-views
    hyperplanes render --checkpoint runs/demo --views photos/ --out new-views --orbit 48 --all-views
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Literal

from hyperplanes.commands.console import Console
from hyperplanes.commands.fields import adapt_to, load_source, render_views
from hyperplanes.commands.options import Free, ObjectArguments, OptionalInt, Protocol, check_orbit, optional
from hyperplanes.commands.scene import read_object, refuse_sources
from hyperplanes.commands.writing import writes_to
from hyperplanes.utilities.formatting import format_duration

__all__ = ["Arguments", "run"]

LARGEST_ORBIT = 400  # pixels of an orbit's pictures where none were asked for: time grows with their square


@dataclass(frozen=True)
class Arguments(ObjectArguments):
    """What to look at, and from where.

    Attributes:
        fine_tune: What fine-tuning optimises: theta + delta itself, or the hypernetwork with theta frozen.
        orbit: So many pictures evenly around the object, and a turntable, instead of the query poses.
        size: Pixels along the longer side of an orbit's pictures; as the images, but 400 at most,
            when not given.
        turntable: The format of the turntable; mp4 and webm need `pip install hyperplanes[video]`.
        protocol: How the field is sampled: as it was trained, 64 + 128 times a ray as in the paper, or by ray
            marching through what is not empty.
    """

    fine_tune: Free = "weights"
    orbit: Annotated[int | None, optional("FRAMES")] = None
    size: OptionalInt = None
    turntable: Literal["webp", "gif", "mp4", "webm"] = "webp"
    protocol: Protocol = "default"


@writes_to(lambda arguments: arguments.out, check=lambda arguments: refuse_sources(arguments.out, arguments.views))
def run(arguments: Arguments) -> int:
    """Adapt, render, write, and say how well it went where the truth is known."""
    from hyperplanes.adaptation.nearest_view import NearestView
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.configuration.presets import PROTOCOLS
    from hyperplanes.data.devices import choose_device
    from hyperplanes.evaluation.suitability import held_out_psnr, worse_than_copying
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.export.images import encode_animation, orbit_cameras, save_images, to_pixels
    from hyperplanes.utilities.files import write_whole
    from hyperplanes.utilities.metrics import psnr, ssim

    check_orbit(arguments.orbit, arguments.size)
    console, device = Console(), choose_device(arguments.device)
    source = load_source(arguments.checkpoint, device, second_pass=arguments.second_pass)
    task, _ = read_object(arguments, console)
    refuse_sources(arguments.out, arguments.views, task.query.names)
    shown, asked = task.support.to(device), task.query.to(device)
    settings = FineTuning(trainable=arguments.fine_tune)
    field, warned = adapt_to(source, shown, task.name, console, steps=arguments.steps, settings=settings)
    cameras = asked.cameras
    if arguments.orbit is not None:
        size = arguments.size or min(max(shown.size), LARGEST_ORBIT)
        cameras = orbit_cameras(shown, arguments.orbit, size=size)
    started = time.perf_counter()
    pictures = render_views(field, cameras, console, PROTOCOLS[arguments.protocol])
    seconds = (time.perf_counter() - started) / cameras.batch_size
    scores = None
    if arguments.orbit is None:
        paths = save_images(pictures.images, arguments.out, asked.names)
        images = pictures.images.clamp(0, 1).to(asked.images.device)
        value = float(psnr(images, asked.images).mean())
        quality = f"{value:.2f} dB PSNR"
        if min(asked.size) >= 11:
            quality += f", {float(ssim(images, asked.images).mean()):.3f} SSIM"
        known = "shown to the model as well" if arguments.all_views else "never shown to the model"
        console.say(f"against the {len(asked)} true views, {known}: {quality}")
        if not arguments.all_views:
            copied = NearestView().adapt(shown).render(cameras).images
            scores = value, float(psnr(copied, asked.images).mean())
    else:
        paths = save_images(pictures.images, arguments.out)
        animation = arguments.out / f"turntable.{arguments.turntable}"
        write_whole(animation, encode_animation(to_pixels(pictures.images), arguments.turntable))
        console.say(f"{animation}: the turntable")
    if scores is None and not isinstance(source, BakedScene) and (arguments.steps == 0 or warned):
        scores = held_out_psnr(source, shown)
        if scores is not None:
            console.say(
                f"without fine-tuning, on support views left out for this: {scores[0]:.2f} dB PSNR, "
                f"copying the nearest view {scores[1]:.2f} dB"
            )
            scores = scores if arguments.steps == 0 else None
    for line in worse_than_copying(shown, *scores, arguments.steps) if scores else []:
        console.warn(f"{task.name}: {line}")
    console.say(f"{arguments.out}: {len(paths)} pictures, {format_duration(seconds)} each")
    return 0
