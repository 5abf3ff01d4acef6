"""Render new views of one object from a few posed images: one forward pass of a model, and gradient steps with --steps.

The images are a folder with transforms.json (of Blender or nerfstudio), a COLMAP model, an export of Polycam, Record3D,
KIRI Engine, RealityCapture or Metashape, a scene of LLFF, IDR or NSVF, or an object of any data set. By default the
model is given half of the views, the support views, and renders the other half, so that the pictures can be compared
with the images. --orbit renders a full turn around the object instead, and --camera-path the frames of a camera path of
nerfstudio's viewer.

Example:
    hyperplanes render --checkpoint small --views example-car --out new-views
    hyperplanes render --checkpoint small --views scene --out new-views
    hyperplanes render --checkpoint small --views scene --out new-views --orbit 48 --all-views
    hyperplanes render --checkpoint small --views scene --out video --camera-path camera_path.json --turntable mp4
    hyperplanes render --checkpoint small --views scene --out geometry --rendered-output-names rgb depth normals
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.inputs.fields import adapt_to, bake_field, load_source, refuse_of_baked, render_views
from hyperplanes.commands.inputs.scene import read_object, read_path, refuse_sources
from hyperplanes.commands.options import (
    Exists,
    Free,
    ObjectArguments,
    OptionalFile,
    OptionalInt,
    Protocol,
    check_fine_tune,
    check_orbit,
    optional,
)
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import writes_to
from hyperplanes.utilities.messages.formatting import counted, format_duration

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

    from hyperplanes.adaptation.base import Renderable
    from hyperplanes.adaptation.correction_network import CorrectionNetwork
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.export.animation import Representation
    from hyperplanes.rendering.images import Pictures
    from hyperplanes.views import Views

__all__ = ["Arguments", "run"]

LARGEST_ORBIT = 400  # most pixels along the longer side of an orbit without --size: time grows with their square
ROUND = 4.0  # seconds of a turntable


@dataclass(frozen=True)
class Arguments(ObjectArguments):
    """The options of `render`.

    Attributes:
        fine_tune: What fine-tuning optimises: the weights theta + delta, or the hypernetwork while theta is frozen.
        orbit: Render this many pictures evenly around the object, and a turntable, instead of the query views.
        camera_path: A JSON file of nerfstudio's viewer or Blender add-on. Its frames are rendered, and an animation.
        dataparser_transforms: nerfstudio's dataparser_transforms.json, for a path that was made in its viewer. It
            transforms the world of the views to that of the path.
        rendered_output_names: The outputs: rgb, depth (16 bits, along the optical axis), normals, accumulation
            (opacity). All but rgb are written to folders of their names.
        size: Pixels along the longer side of the pictures of an orbit or a camera path. By default, an orbit has the
            size of the images, but at most 400 pixels, and a path the size in its file.
        turntable: The file format of the animation. mp4 and webm need `pip install 'hyperplanes[video]'`.
        representation: What is rendered: the field, or voxels that are baked from it and fitted to the support views.
            Voxels take half a minute once, and then milliseconds a picture. auto uses voxels for an orbit or a camera
            path if that is faster for all its pictures and there are at least 16 support views.
        residuals: Add the differences between the support views and their renderings to the pictures, at places that
            both see. This renders all support views first. auto: as the model is configured; `small` does so with at
            least three views that are not large.
        protocol: How the field is sampled: default, as in training; paper, 64 + 128 samples on each ray; or
            ray_marching, which takes samples only in occupied voxels.
    """

    fine_tune: Free = "weights"
    orbit: Annotated[int | None, optional("FRAMES")] = None
    camera_path: Annotated[OptionalFile, Exists("a JSON file with a camera path")] = None
    dataparser_transforms: Annotated[OptionalFile, Exists("nerfstudio's dataparser_transforms.json")] = None
    rendered_output_names: tuple[Literal["rgb", "depth", "normals", "accumulation"], ...] = ("rgb",)
    size: OptionalInt = None
    turntable: Literal["webp", "gif", "mp4", "webm"] = "webp"
    representation: Literal["auto", "field", "voxels"] = "auto"
    residuals: Literal["auto", "on", "off"] = "auto"
    protocol: Protocol = "default"


@dataclass(frozen=True)
class Asked:
    """The pictures to render.

    Attributes:
        cameras: one camera per picture.
        names: the names of the pictures.
        animation: the name of the file of an animation, and its duration in seconds; None for the query views.
    """

    cameras: PinholeCamera
    names: Sequence[str] = ()
    animation: tuple[str, float] | None = None


@writes_to(lambda arguments: arguments.out, check=lambda arguments: refuse_sources(arguments.out, arguments.views))
def run(arguments: Arguments) -> int:
    """Adapt, render, write the pictures, and print their PSNR if the true images are known."""
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.configuration.presets import PROTOCOLS
    from hyperplanes.data.devices import choose_device
    from hyperplanes.evaluation.suitability import worse_than_copying
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.export.images import encode_animation
    from hyperplanes.export.outputs import output_frames, save_outputs
    from hyperplanes.utilities.files.writing import write_whole
    from hyperplanes.utilities.messages.errors import listed

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
    network = source.corrector if isinstance(source, HyperPlanes) else None
    field, corrected = _drawn(arguments, field, shown, asked, network, console)
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
            console.say(f"{path}: an animation of {lasting:.3g} seconds")
    if scores is None and not isinstance(source, BakedScene) and (arguments.steps == 0 or warned):
        scores = _held_out(arguments, source, shown, corrected, console)
    steps = None if isinstance(source, BakedScene) else arguments.steps
    for line in worse_than_copying(shown, *scores, steps) if scores else []:
        console.warn(f"{task.name}: {line}")
    if older := sorted({path.name for path in arguments.out.glob("*.png")} - {path.name for path in paths}):
        console.warn(f"{arguments.out}: pictures that this command did not write are there: {listed(older)}")
    how = " (colours corrected by residuals)" if corrected else ""
    console.say(f"{arguments.out}: {counted(len(paths), 'picture')}{how}, {format_duration(seconds)} a view")
    return 0


def _drawn(
    arguments: Arguments,
    field: Renderable,
    shown: Views,
    asked: Asked,
    network: CorrectionNetwork | None,
    console: Console,
) -> tuple[Renderable, bool]:
    """The field, or its voxels, with residuals if requested, and whether there are residuals.

    The network computes the correction of a field; that of voxels is the mean residual.
    """
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.adaptation.correction.residuals import CorrectedField, ResidualField
    from hyperplanes.export.animation import choose_representation
    from hyperplanes.export.voxel_fitting import VOXEL_STEPS

    make = partial(bake_field, fit=VOXEL_STEPS, console=console)
    field = choose_representation(field, shown, asked.cameras, _representation(arguments, asked), make=make)
    if arguments.residuals == "on" and not isinstance(field, CorrectedField):
        field = ResidualField(field, shown, network if isinstance(field, AdaptedField) else None)
    residuals = field.residuals if isinstance(field, CorrectedField) else field
    if not isinstance(residuals, ResidualField):
        return field, False
    with console.bar("residuals") as bar:
        residuals.prepare(lambda done: bar.show(done, len(shown), "support views"))
    return field, True


def _representation(arguments: Arguments, asked: Asked) -> Representation:
    """The representation that is passed on: "auto" becomes "field", except for animations with the rgb output alone."""
    colours_alone = set(arguments.rendered_output_names) == {"rgb"} and arguments.protocol == "default"
    if arguments.representation == "auto" and (asked.animation is None or not colours_alone):
        return "field"
    return arguments.representation


def _check(arguments: Arguments) -> None:
    """Refuse options that cannot be combined, and formats of animations that cannot be encoded on this machine."""
    from hyperplanes.export.images import require_encoder

    if arguments.camera_path is not None or arguments.orbit is not None:
        require_encoder(arguments.turntable)
    if not arguments.rendered_output_names:
        raise ValueError("--rendered-output-names: expected at least one of rgb, depth, normals and others, got none")
    if arguments.turntable != "webp" and arguments.orbit is None and arguments.camera_path is None:
        raise ValueError(
            f"--turntable: expected --orbit or --camera-path as well, got {arguments.turntable} alone; add one of them"
        )
    if arguments.representation == "voxels" and arguments.protocol != "default":
        raise ValueError(
            "--protocol: expected none with --representation voxels, because only fields have one; leave one out"
        )
    if arguments.residuals == "on" and arguments.protocol != "default":
        raise ValueError(
            f"--protocol: expected none with --residuals on, which are computed with the protocol of training, got "
            f"{arguments.protocol}; leave one out"
        )
    if arguments.camera_path is None:
        check_orbit(arguments.orbit, arguments.size, "--camera-path")
        if arguments.dataparser_transforms is not None:
            raise ValueError("--dataparser-transforms: expected --camera-path as well, got none; name a camera path")
        return
    if arguments.orbit is not None:
        raise ValueError("--camera-path, --orbit: expected one of them, got both; leave one out")
    if arguments.size is not None and arguments.size < 1:
        raise ValueError(f"--size: expected at least 1 pixel, got {arguments.size}")


def _asked(arguments: Arguments, shown: Views, known: Views, up: str, console: Console) -> Asked:
    """The cameras of a camera path, of an orbit, or of the query views."""
    from hyperplanes.export.images import orbit_cameras

    if arguments.camera_path is not None:
        path, transforms = arguments.camera_path, arguments.dataparser_transforms
        cameras, seconds = read_path(path, transforms, arguments.size, shown, up, arguments.views, console)
        return Asked(cameras, animation=("camera_path", seconds))
    if arguments.orbit is not None:
        size = arguments.size or min(max(shown.size), LARGEST_ORBIT)
        return Asked(orbit_cameras(shown, arguments.orbit, size=size), animation=("turntable", ROUND))
    return Asked(known.cameras, known.names)


def _held_out(
    arguments: Arguments, source: HyperPlanes, shown: Views, corrected: bool, console: Console
) -> tuple[float, float] | None:
    """Print what `held_out_psnr` returns, and return it if the field has no gradient steps, as in that comparison."""
    from hyperplanes.evaluation.suitability import held_out_psnr

    scores = held_out_psnr(source, shown)
    if scores is not None:
        without = " and residuals" if corrected else ""
        console.say(
            f"estimate, from fewer views than the pictures and without fine-tuning{without}: {scores[0]:.2f} dB PSNR "
            f"on held-out support views; copying the nearest view has {scores[1]:.2f} dB"
        )
    return scores if arguments.steps == 0 else None


def _compared(
    pictures: Pictures, shown: Views, known: Views, all_views: bool, finished: bool, console: Console
) -> tuple[float, float] | None:
    """Print PSNR and SSIM of the pictures; returns the mean PSNR of the pictures and of the nearest support views.

    The result is None if the model was given the views that are compared. `finished` is true for a baked file and for
    the weights of one object, which do not record the views that they were made from.
    """
    from hyperplanes.adaptation.baselines.nearest_view import NearestView
    from hyperplanes.utilities.images.metrics import psnr, ssim

    images = pictures.images.clamp(0, 1).to(known.images.device)
    value = float(psnr(images, known.images).mean())
    quality = f"{value:.2f} dB PSNR"
    if min(known.size) >= 11:
        quality += f", {float(ssim(images, known.images).mean()):.3f} SSIM"
    now = "not given now, but perhaps when it was adapted" if finished else "not given to the model"
    how = "given to the model as well" if all_views else now
    console.say(f"against the {counted(len(known), 'true view')}, {how}: {quality}")
    if all_views:
        return None
    copied = NearestView().adapt(shown).render(known.cameras).images
    return value, float(psnr(copied, known.images).mean())
