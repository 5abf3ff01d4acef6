"""Reads the posed images that a verb is given, and rotates their world so that y is up."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hyperplanes.data.packaged import locate_scene

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.commands.options import ObjectArguments, ViewsArguments
    from hyperplanes.commands.output.console import Console
    from hyperplanes.data.pictures.posed import Posed
    from hyperplanes.export.baking import BakedScene
    from hyperplanes.geometry.rays import Sphere
    from hyperplanes.views import Task, Views

__all__ = ["prepare_task", "read_object", "read_path", "read_scene", "refuse_sources", "say_up"]


def read_object(arguments: ObjectArguments, source: HyperPlanes | BakedScene, console: Console) -> tuple[Task, str]:
    """As `read_scene`, with the options that the verbs for one object share.

    If requested, the background is learned and the poses are refined. It warns if the model is the weights of another
    object.

    Args:
        arguments: the options.
        source: the model that will adapt to the views, or a baked scene.
        console: prints messages.
    """
    from hyperplanes.commands.inputs.object_record import warn_of_other_object

    task, up = read_scene(
        arguments.views,
        console,
        all_views=arguments.all_views,
        up=arguments.up,
        downscale=arguments.downscale,
    )
    if not arguments.learn_background:
        warn_of_other_object(arguments.checkpoint, task.support, console)
    return prepare_task(arguments, task, source, console, all_views=arguments.all_views), up


def prepare_task(
    arguments: ViewsArguments, task: Task, source: HyperPlanes | BakedScene, console: Console, *, all_views: bool
) -> Task:
    """The task, with a learned background and refined poses if these are requested.

    Args:
        arguments: the options.
        task: the support and the query views.
        source: the model that will adapt to the views, or a baked scene.
        console: prints messages.
        all_views: whether support and query views are the same.
    """
    from hyperplanes.adaptation.hyperplanes import HyperPlanes
    from hyperplanes.commands.inputs.background import cut_out_task
    from hyperplanes.commands.inputs.poses import check_support, refine_task

    if arguments.refine_poses:
        check_support(task)
    if arguments.learn_background:
        task = cut_out_task(task, console, all_views=all_views)
    if arguments.refine_poses:
        assert isinstance(source, HyperPlanes)
        task = refine_task(source, task, console, all_views=all_views)
    return task


def read_scene(
    path: Path, console: Console, *, all_views: bool = False, up: str = "auto", downscale: int | None = None
) -> tuple[Task, str]:
    """The support and the query views of a scene; with `all_views`, both are all views.

    It warns of images that were left out, rotated or scaled, and prints the up direction if `up` is "auto".

    Args:
        path: the posed images, or the name of a scene that comes with the package.
        console: prints messages.
        all_views: whether all views are support views.
        up: the direction that points up in the world of the files, as in `y_up_from`, or "auto": the direction that the
            files state, or else a guess from how the cameras are held.
        downscale: as in `read_views`.

    Returns:
        The task in a world with y up, and the direction that was up before.
    """
    from hyperplanes.data.formats.recognise import read_posed, read_posed_task, scene_name
    from hyperplanes.data.upright import upright_task
    from hyperplanes.utilities.files.reading import malformed
    from hyperplanes.views import Task

    path = locate_scene(path)
    with malformed(path, "posed images of one scene"):
        if all_views:
            scene = read_posed(path, downscale)
            views, notes = scene.views(), scene.notes
            task = Task(views, views, scene_name(path))
        else:
            posed = read_posed_task(path, downscale)
            task, notes = posed.task(), posed.notes
    for note in notes:
        console.warn(f"{path}: {note}")
    if up == "auto":
        up = say_up([task.support] if all_views else [task.support, task.query], console)
    return upright_task(task, up), up


def read_path(
    path: Path, transforms: Path | None, size: int | None, shown: Views, up: str, scene: Path, console: Console
) -> tuple[PinholeCamera, float]:
    """The cameras of a camera path, in the world of the support views, and the duration of its video in seconds.

    It warns if no camera of the path sees the object, as happens if the path belongs to another world.

    Args:
        path: the file of the camera path.
        transforms: nerfstudio's dataparser_transforms.json, or None.
        size: pixels along the longer side; None takes the size in the file.
        shown: the support views, in a world with y up.
        up: the direction that was up in their world before.
        scene: the folder that they were read from.
        console: prints messages.
    """
    from hyperplanes.data.camera_path import read_camera_path
    from hyperplanes.data.formats.recognise import read_posed
    from hyperplanes.data.upright import upright_cameras
    from hyperplanes.geometry import cameras as camera
    from hyperplanes.utilities.files.reading import read_json
    from hyperplanes.utilities.images.sizes import scaled_size

    listed = locate_scene(scene)
    listed = listed if listed.is_file() else listed / "transforms.json"
    document = read_json(listed) if listed.suffix == ".json" and listed.is_file() else None
    found = read_camera_path(path, transforms, document)
    cameras = upright_cameras(found.cameras, up)
    away = (camera.centres(cameras) - cameras.extrinsics.new_tensor(shown.bounds.centre)).norm(dim=1)
    if float(away.min()) > FAR * shown.bounds.radius:  # views far from the origin were shifted, but not the path
        found = read_camera_path(path, transforms, document, read_posed(locate_scene(scene)).origin)
        cameras = upright_cameras(found.cameras, up)
    for note in found.notes:
        console.warn(f"{path}: {note}")
    height, width = camera.image_size(cameras)
    if size is not None:
        cameras = camera.resized(cameras, *scaled_size((height, width), size, enlarge=True))
    elif max(height, width) > LARGEST_UNASKED:
        console.say(
            f"{path}: pictures of {width}x{height}, the size in this file; smaller ones (--size) take less time"
        )
    if not _is_seen(shown.bounds, cameras):
        console.warn(
            f"{path}: none of its {cameras.batch_size} cameras looks at the object; a path of nerfstudio's viewer is "
            "in the world of its model: --dataparser-transforms outputs/.../dataparser_transforms.json"
        )
    return cameras, found.seconds


FAR = 100
"""Distance of all cameras of a path from the centre of the scene, in radii of the scene, above which the path may be
in a world with another origin."""

LARGEST_UNASKED = 400
"""Pixels along the longer side above which the pictures of a camera path take long, so that a message says so."""


def _is_seen(bounds: Sphere, cameras: PinholeCamera) -> bool:
    """Whether any camera sees a part of a sphere; a camera sees the smallest cone that contains its picture."""
    import torch

    from hyperplanes.geometry import cameras as camera

    away = cameras.extrinsics.new_tensor(bounds.centre) - camera.centres(cameras)
    distance = away.norm(dim=-1).clamp_min(1e-12)
    angle = torch.acos(((away * camera.viewing_directions(cameras)).sum(-1) / distance).clamp(-1, 1))
    radius = torch.asin((bounds.radius / distance).clamp_max(1.0))
    height, width = camera.image_size(cameras)
    cone = torch.atan(math.hypot(height, width) / 2 / camera.intrinsics(cameras)[:, 0, 0])
    return bool(((angle < cone + radius) | (distance < bounds.radius)).any())


def say_up(parts: Sequence[Views | Posed], console: Console) -> str:
    """The up direction of one scene, which is also printed: as stated, guessed from how the cameras are held, or y.

    Args:
        parts: the views of the scene, in one or more sets.
        console: prints the direction.
    """
    from hyperplanes.data.upright import guess_up
    from hyperplanes.geometry import cameras as camera

    if (stated := parts[0].up) is not None:
        console.say(f"up: {stated}, as the files state; --up overrides it")
        return stated
    guessed = guess_up(camera.concatenate([part.cameras for part in parts]))
    console.say(
        f"up: {guessed}, guessed from how the cameras are held; --up overrides it"
        if guessed
        else "up: y, because the cameras show no up direction; --up overrides it"
    )
    return guessed or "y"


INPUT = re.compile(r"images(_\d+)?|image|input|rgb|masks?|pose|sparse|dense|distorted|colmap")
"""Names of the folders of a scene from which files are read."""


def refuse_sources(folder: Path, path: Path, task: Task | None = None) -> None:
    """Refuse to write pictures over the images of a scene, or into a folder where they would be read as its images.

    Args:
        folder: the folder to write into.
        path: the posed images that are read, or a data set.
        task: the views that were read from it, if they were read already.

    Raises:
        ValueError: the folder contains images of `task`, or has the name of a folder from which a scene is read.
    """
    from hyperplanes.data.formats.recognise import is_scene

    path = locate_scene(path)
    root = (path if path.is_dir() else path.parent).resolve()
    target = folder.resolve()
    names = () if task is None else (*task.support.names, *task.query.names)
    sources = {(root / name).parent.resolve() for name in names}
    inner = target.relative_to(root).parts if target.is_relative_to(root) else ()
    scenes = [root] if len(inner) < 2 or not is_scene(root / inner[0]) else [root, root / inner[0]]
    read = any(INPUT.fullmatch(part) for part, _ in zip(inner, scenes, strict=False))
    if target in sources or read:
        raise ValueError(
            f"--out: expected a folder that no images or poses are read from, got {folder}, which is one of {path}; "
            "name another"
        )
