"""One object as images, a turntable and a mesh with coloured vertices, from a few posed images of it.

The mesh is the surface on which the density crosses a level (marching cubes). GLB opens in a browser or a slide show,
PLY in MeshLab and Blender.

Example:
    hyperplanes export --checkpoint runs/demo --views photos/ --out chair
    hyperplanes export --checkpoint runs/demo --views photos/ --out chair --what mesh --mesh-format glb --voxels 192
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import OptionalInt, Up, optional
from hyperplanes.commands.render import read_scene

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments:
    """What to write.

    Attributes:
        checkpoint: What `train`, `adapt` or `demo` wrote.
        views: The posed images of the object.
        out: The folder to write to.
        what: Any of the three.
        steps: Fine-tuning steps on the shown views.
        frames: Of the turntable.
        size: Pixels along the longer side of the turntable; as the images when not given.
        turntable: The format of the turntable.
        mesh_format: The format of the mesh.
        voxels: Along each side of the grid that the mesh is cut from.
        level: Density at the surface; half opaque within 1/64 of the scene when not given.
        all_views: Show the model every view, not only the support half.
        up: The axis that points up in the world of the views: y as in training data, z as in Blender. What is written
            has y up.
        device: auto, cpu or cuda.
    """

    checkpoint: Path
    views: Path
    out: Path
    what: tuple[Literal["images", "turntable", "mesh"], ...] = ("images", "turntable", "mesh")
    steps: int = 0
    frames: int = 48
    size: OptionalInt = None
    turntable: Literal["webp", "gif"] = "webp"
    mesh_format: Literal["ply", "glb", "obj"] = "ply"
    voxels: int = 128
    level: Annotated[float | None, optional("DENSITY")] = None
    all_views: bool = False
    up: Up = "y"
    device: str = "auto"


def run(arguments: Arguments) -> int:
    """Adapt and write what was asked for."""
    from hyperplanes.files import one_writer

    with one_writer(arguments.out):
        return _run(arguments)


def _run(arguments: Arguments) -> int:
    from hyperplanes.adaptation.pretrained import load_model
    from hyperplanes.devices import choose_device
    from hyperplanes.export import extract_mesh, save_images, save_mesh, save_turntable

    console, device, out = Console(), choose_device(arguments.device), arguments.out
    model = load_model(arguments.checkpoint).to(device)
    task = read_scene(arguments.views, arguments.all_views, arguments.up)
    shown = task.support.to(device)
    field = model.fine_tune(shown, arguments.steps)
    console.say(f"adapted to {len(shown)} views of {task.name}")
    if "images" in arguments.what:
        query = task.query.to(device)
        paths = save_images(field.render(query.cameras).images, out / "images", query.names)
        console.say(f"{out / 'images'}: {len(paths)} pictures of the query poses")
    if "turntable" in arguments.what:
        path = out / f"turntable.{arguments.turntable}"
        save_turntable(field, shown, path, frames=arguments.frames, size=arguments.size)
        console.say(f"{path}: {arguments.frames} frames")
    if "mesh" in arguments.what:
        surface = extract_mesh(field, voxels=arguments.voxels, level=arguments.level)
        path = save_mesh(surface, out / f"mesh.{arguments.mesh_format}")
        console.say(f"{path}: {len(surface.vertices):,} vertices, {len(surface.faces):,} faces")
    return 0
