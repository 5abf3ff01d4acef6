"""Turn one adapted object into a sparse voxel grid: one small file that is rendered quickly, without a network.

The grid has the density and the view-dependent colour (spherical harmonics) of the voxels that can be seen. They are
fitted to the support views, which recovers what baking loses, and more. To show the cost, the output has the PSNR of
the baked pictures and of the field's own pictures on the query views.

Example:
    hyperplanes bake --checkpoint small --views scene --out chair.safetensors
    hyperplanes bake --checkpoint small --views scene --out chair.safetensors --voxels 384 --orbit 96
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.inputs.fields import adapt_to, bake_field, load_adaptable, refuse_baked
from hyperplanes.commands.inputs.scene import read_object, refuse_sources
from hyperplanes.commands.options import ObjectArguments, OptionalInt, check_orbit, optional
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import check_output, refuse_checkpoint
from hyperplanes.utilities.messages.formatting import format_duration

if TYPE_CHECKING:
    from torch import Tensor

    from hyperplanes.views import Task

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments(ObjectArguments):
    """The options of `bake`.

    Attributes:
        voxels: Voxels along each side of the grid. By default 1.4 per pixel of the images, at least 64 and at most 256.
        fit: Gradient steps that fit the voxels to the support views. With 0, they keep the field's colours and
            densities.
        orbit: Also write a turntable of this many frames beside the file, rendered from the voxels.
        size: Pixels along the longer side of the turntable. By default as many as the images have.
        turntable: The file format of the turntable. mp4 and webm need `pip install 'hyperplanes[video]'`.
    """

    voxels: OptionalInt = None
    fit: Annotated[int, range(10_000)] = 100
    orbit: Annotated[int | None, optional("FRAMES")] = None
    size: OptionalInt = None
    turntable: Literal["webp", "gif", "mp4", "webm"] = "webp"


def _timed(action: Callable[[], Tensor]) -> tuple[float, Tensor]:
    started = time.perf_counter()
    result = action()
    return time.perf_counter() - started, result


def _refuse_sources(arguments: Arguments, task: Task | None = None) -> None:
    """As `refuse_sources`, if a turntable is written, because it could be read later as an image of the scene."""
    if arguments.orbit is not None:
        refuse_sources(arguments.out.parent, arguments.views, task)


def run(arguments: Arguments) -> int:
    """Adapt, bake, write the file, and print the speed and the PSNR of the voxels."""
    from hyperplanes.adaptation.base import AdaptedField
    from hyperplanes.data.devices import choose_device
    from hyperplanes.export.baking import BakedScene, coarsening, default_side
    from hyperplanes.export.images import encode_animation, orbit_cameras, require_encoder, to_pixels
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.utilities.files.writing import write_whole
    from hyperplanes.utilities.images.metrics import psnr
    from hyperplanes.utilities.messages.errors import rename_errors

    _refuse_sources(arguments)
    check_output("out", arguments.out)
    if arguments.out.suffix != ".safetensors":
        raise ValueError(f"--out: expected a name that ends in .safetensors, got {arguments.out}; add the ending")
    refuse_checkpoint(arguments.out, arguments.checkpoint)
    check_orbit(arguments.orbit, arguments.size)
    if arguments.orbit is not None:
        require_encoder(arguments.turntable)
    elif arguments.turntable != "webp":
        raise ValueError(f"--turntable: expected --orbit as well, got {arguments.turntable} alone; add --orbit")
    if arguments.voxels is not None:
        with rename_errors("side", "--voxels"):
            coarsening(arguments.voxels)
    console, device = Console(), choose_device(arguments.device)
    refuse_baked(arguments.checkpoint, "bake")
    model = load_adaptable(arguments.checkpoint, device, reflections=not arguments.no_reflections)
    task, _ = read_object(arguments, model, console)
    _refuse_sources(arguments, task)
    shown, query = task.support.to(device), task.query
    field, _ = adapt_to(model, shown, task.name, console, steps=arguments.steps)
    assert isinstance(field, AdaptedField)
    field = field.without_residuals()
    side = arguments.voxels or default_side(shown.size)
    baked = bake_field(field, shown, side, fit=arguments.fit, console=console)
    baked.save(arguments.out)
    console.say(f"{arguments.out}: {arguments.out.stat().st_size / 2**20:.1f} MiB")
    scene = BakedScene(baked)
    first = camera.select(query.cameras, [0])
    for each in (scene, field):
        each.render(first)  # compile kernels and find the occupied voxels before time is measured
    slow, before = _timed(lambda: field.render(query.cameras).images.clamp(0, 1).cpu())
    fast, after = _timed(lambda: scene.render(query.cameras).images.clamp(0, 1))
    kind = "support" if arguments.all_views else "query"
    console.say(
        f"{len(query)} {kind} views: {format_duration(fast / len(query))} each, "
        f"{slow / fast:.0f} times the field's speed; "
        f"{float(psnr(after, query.images).mean()):.2f} dB, the field {float(psnr(before, query.images).mean()):.2f} dB"
    )
    if arguments.orbit is not None:
        cameras = orbit_cameras(task.support, arguments.orbit, size=arguments.size)
        path = arguments.out.with_suffix(f".{arguments.turntable}")
        write_whole(path, encode_animation(to_pixels(scene.render(cameras).images), arguments.turntable))
        console.say(f"{path}: {arguments.orbit} frames")
    return 0
