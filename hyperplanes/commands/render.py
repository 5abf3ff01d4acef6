"""New views of one object from a few posed images: one forward pass of a model, and gradient steps with --steps.

The images come as a folder with transforms.json (Blender's, nerfstudio's), a COLMAP model, what Polycam, Record3D,
KIRI Engine, RealityCapture or Metashape export, a scene of LLFF, IDR or NSVF, or an object of any data set. The model
is shown the support half of the views and asked for the other half, so that the result can be compared with the truth;
--orbit asks for a full turn around the object instead, --camera-path for the frames of a path of nerfstudio's viewer.

Example:
    hyperplanes render --checkpoint small --views example-car --out new-views
    hyperplanes render --checkpoint runs/demo --views scene --out new-views
    hyperplanes render --checkpoint runs/demo --views scene --out new-views --orbit 48 --all-views
    hyperplanes render --checkpoint small --views scene --out video --camera-path camera_path.json --turntable mp4
    hyperplanes render --checkpoint small --views scene --out geometry --rendered-output-names rgb depth normals
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.console import Console
from hyperplanes.commands.fields import adapt_to, bake_field, load_source, refuse_of_baked, render_views
from hyperplanes.commands.options import (
    Free,
    ObjectArguments,
    OptionalFile,
    OptionalInt,
    Protocol,
    check_fine_tune,
    check_orbit,
    optional,
)
from hyperplanes.commands.scene import read_object, read_path, refuse_sources
from hyperplanes.commands.writing import writes_to
from hyperplanes.utilities.formatting import format_duration

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

    from hyperplanes.export.animation import Representation
    from hyperplanes.rendering.images import Pictures
    from hyperplanes.views import Views

__all__ = ["Arguments", "run"]

LARGEST_ORBIT = 400  # pixels of an orbit's pictures where none were asked for: time grows with their square
ROUND = 4.0  # seconds of a turntable


@dataclass(frozen=True)
class Arguments(ObjectArguments):
    """What to look at, and from where.

    Attributes:
        fine_tune: What fine-tuning optimises: theta + delta itself, or the hypernetwork with theta frozen.
        orbit: This many pictures evenly around the object, and a turntable, instead of the query poses.
        camera_path: A JSON of nerfstudio's viewer or Blender add-on: the pictures of its frames, and an animation.
        dataparser_transforms: nerfstudio's dataparser_transforms.json, where the path was made in its viewer: from the
            world of the views to that of the path.
        rendered_output_names: What is drawn: rgb, depth (16 bits, along the optical axis), normals, accumulation
            (opacity); all but rgb into folders of their names.
        size: Pixels along the longer side of the pictures of an orbit or a path; of an orbit as the images, but 400 at
            most, when not given.
        turntable: The format of the animation; mp4 and webm need `pip install 'hyperplanes[video]'`.
        representation: What draws the pictures: the field itself, or voxels that are baked from it and fitted to the
            shown views, which takes half a minute once and milliseconds a picture. auto takes voxels for an orbit or
            a path of enough pictures for this to be faster, where 16 views or more are shown.
        residuals: Add to the pictures what the field lacks where the shown views see the same places. All shown views
            are rendered for that first. auto: where the model does so, `small` from 10 views on, unless they are large.
        protocol: How the field is sampled: as it was trained, 64 + 128 times a ray as in the paper, or by ray
            marching through what is not empty.
    """

    fine_tune: Free = "weights"
    orbit: Annotated[int | None, optional("FRAMES")] = None
    camera_path: OptionalFile = None
    dataparser_transforms: OptionalFile = None
    rendered_output_names: tuple[Literal["rgb", "depth", "normals", "accumulation"], ...] = ("rgb",)
    size: OptionalInt = None
    turntable: Literal["webp", "gif", "mp4", "webm"] = "webp"
    representation: Literal["auto", "field", "voxels"] = "auto"
    residuals: Literal["auto", "on", "off"] = "auto"
    protocol: Protocol = "default"


@dataclass(frozen=True)
class Asked:
    """What is rendered.

    Attributes:
        cameras: one a picture.
        names: of the pictures.
        animation: the name of a file for all of them, and the seconds that it lasts; None for poses whose pictures are
            known.
    """

    cameras: PinholeCamera
    names: Sequence[str] = ()
    animation: tuple[str, float] | None = None


@writes_to(lambda arguments: arguments.out, check=lambda arguments: refuse_sources(arguments.out, arguments.views))
def run(arguments: Arguments) -> int:
    """Adapt, render, write, and say how well it went where the truth is known."""
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.adaptation.residuals import CorrectedField, ResidualField
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.configuration.presets import PROTOCOLS
    from hyperplanes.data.devices import choose_device
    from hyperplanes.evaluation.suitability import held_out_psnr, worse_than_copying
    from hyperplanes.export.animation import choose_representation
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.export.images import encode_animation
    from hyperplanes.export.outputs import output_frames, save_outputs
    from hyperplanes.export.voxel_fitting import STEPS as VOXEL_STEPS
    from hyperplanes.utilities.errors import listed
    from hyperplanes.utilities.writing import write_whole

    _check(arguments)
    console, device = Console(), choose_device(arguments.device)
    source = load_source(arguments.checkpoint, device, reflections=not arguments.no_reflections)
    given = {
        "--steps": arguments.steps != 0,
        "--learn-background": arguments.learn_background,
        "--refine-poses": arguments.refine_poses,
        "--protocol": arguments.protocol != "default",
        "--fine-tune": arguments.fine_tune != "weights",
        "--no-reflections": arguments.no_reflections,
        "--representation": arguments.representation == "field",
    }
    refuse_of_baked(source, given)
    check_fine_tune(arguments.fine_tune, arguments.steps)
    task, up = read_object(arguments, source, console)
    refuse_sources(arguments.out, arguments.views, task)
    shown, known = task.support.to(device), task.query.to(device)
    asked = _asked(arguments, shown, known, up, console)
    settings = FineTuning(trainable=arguments.fine_tune)
    if isinstance(source, HyperPlanes) and (arguments.residuals == "off" or arguments.protocol != "default"):
        source = source.without_residuals()
    field, warned = adapt_to(source, shown, task.name, console, steps=arguments.steps, settings=settings)
    make = partial(bake_field, fit=VOXEL_STEPS, console=console)
    field = choose_representation(field, shown, asked.cameras, _representation(arguments, asked), make=make)
    if arguments.residuals == "on" and not isinstance(field, CorrectedField):
        field = ResidualField(field, shown)
    residuals = field.residuals if isinstance(field, CorrectedField) else field
    corrected = isinstance(residuals, ResidualField)
    if corrected:
        with console.bar("residuals") as bar:
            residuals.prepare(lambda done: bar.show(done, len(shown), "shown views"))
    started = time.perf_counter()
    pictures = render_views(field, asked.cameras, console, PROTOCOLS[arguments.protocol])
    seconds = (time.perf_counter() - started) / asked.cameras.batch_size
    outputs = tuple(dict.fromkeys(arguments.rendered_output_names))
    paths = save_outputs(outputs, pictures, asked.cameras, arguments.out, asked.names)
    scores = None
    if asked.animation is None:
        finished = isinstance(source, BakedScene) or source.hypernetwork is None
        scores = _compared(pictures, shown, known, arguments.all_views, finished, console)
    else:
        name, lasting = asked.animation
        for output in outputs:
            path = (arguments.out if output == "rgb" else arguments.out / output) / f"{name}.{arguments.turntable}"
            frames = output_frames(output, pictures, asked.cameras)
            write_whole(path, encode_animation(frames, arguments.turntable, lasting))
            console.say(f"{path}: {lasting:.3g} seconds of them")
    if scores is None and not isinstance(source, BakedScene) and (arguments.steps == 0 or warned):
        scores = held_out_psnr(source, shown)
        if scores is not None:
            without = " and residuals" if corrected else ""
            console.say(
                f"without fine-tuning{without}, on support views left out for this: {scores[0]:.2f} dB PSNR, "
                f"copying the nearest view {scores[1]:.2f} dB"
            )
            scores = scores if arguments.steps == 0 else None
    steps = None if isinstance(source, BakedScene) else arguments.steps
    for line in worse_than_copying(shown, *scores, steps) if scores else []:
        console.warn(f"{task.name}: {line}")
    if older := sorted({path.name for path in arguments.out.glob("*.png")} - {path.name for path in paths}):
        console.warn(f"{arguments.out}: pictures that this command did not write are there: {listed(older)}")
    how = " corrected by residuals" if corrected else ""
    console.say(f"{arguments.out}: {len(paths)} pictures{how}, {format_duration(seconds)} a view")
    return 0


def _representation(arguments: Arguments, asked: Asked) -> Representation:
    """What draws the pictures: as told, and by default the field, but for the colours of animations."""
    colours_alone = set(arguments.rendered_output_names) == {"rgb"} and arguments.protocol == "default"
    if arguments.representation == "auto" and (asked.animation is None or not colours_alone):
        return "field"
    return arguments.representation


def _check(arguments: Arguments) -> None:
    """Refuse options of a camera path or an orbit that say nothing together, or cannot be encoded here."""
    from hyperplanes.export.images import require_encoder

    if arguments.camera_path is not None or arguments.orbit is not None:
        require_encoder(arguments.turntable)
    if not arguments.rendered_output_names:
        raise ValueError("--rendered-output-names: expected at least one of rgb, depth, normals and others, got none")
    if arguments.turntable != "webp" and arguments.orbit is None and arguments.camera_path is None:
        raise ValueError(
            f"--turntable: expected --orbit or --camera-path, whose animation it is of, got {arguments.turntable} alone"
        )
    if arguments.representation == "voxels" and arguments.protocol != "default":
        raise ValueError(
            "--protocol: expected none with --representation voxels, which are not sampled so; leave one out"
        )
    if arguments.residuals == "on" and arguments.protocol != "default":
        raise ValueError(
            f"--protocol: expected none with --residuals on, which are of the field as it was trained, got "
            f"{arguments.protocol}; leave one out"
        )
    if arguments.camera_path is None:
        check_orbit(arguments.orbit, arguments.size, "--camera-path")
        if arguments.dataparser_transforms is not None:
            raise ValueError(
                "--dataparser-transforms: expected --camera-path, whose world it is of, got none; name one"
            )
        return
    if arguments.orbit is not None:
        raise ValueError("--camera-path, --orbit: expected one of them, got both; leave one out")
    if arguments.size is not None and arguments.size < 1:
        raise ValueError(f"--size: expected at least 1 pixel, got {arguments.size}")


def _asked(arguments: Arguments, shown: Views, known: Views, up: str, console: Console) -> Asked:
    """The cameras of a path, of an orbit, or of the query views."""
    from hyperplanes.export.images import orbit_cameras

    if arguments.camera_path is not None:
        path, transforms = arguments.camera_path, arguments.dataparser_transforms
        cameras, seconds = read_path(path, transforms, arguments.size, shown, up, arguments.views, console)
        return Asked(cameras, animation=("camera_path", seconds))
    if arguments.orbit is not None:
        size = arguments.size or min(max(shown.size), LARGEST_ORBIT)
        return Asked(orbit_cameras(shown, arguments.orbit, size=size), animation=("turntable", ROUND))
    return Asked(known.cameras, known.names)


def _compared(
    pictures: Pictures, shown: Views, known: Views, all_views: bool, finished: bool, console: Console
) -> tuple[float, float] | None:
    """The mean PSNR of pictures and of the nearest views, where the model was not shown what they are compared to.

    What was finished before, a baked file or the weights of one object, does not say which views it was made of.
    """
    from hyperplanes.adaptation.nearest_view import NearestView
    from hyperplanes.utilities.metrics import psnr, ssim

    images = pictures.images.clamp(0, 1).to(known.images.device)
    value = float(psnr(images, known.images).mean())
    quality = f"{value:.2f} dB PSNR"
    if min(known.size) >= 11:
        quality += f", {float(ssim(images, known.images).mean()):.3f} SSIM"
    now = "not shown now, but perhaps before" if finished else "never shown to the model"
    how = "shown to the model as well" if all_views else now
    console.say(f"against the {len(known)} true views, {how}: {quality}")
    if all_views:
        return None
    copied = NearestView().adapt(shown).render(known.cameras).images
    return value, float(psnr(copied, known.images).mean())
