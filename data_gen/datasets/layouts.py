"""File layouts of rendered objects: the native one, and those of other projects' loaders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from data_gen.datasets.sources import Item
from data_gen.rigs import DEFAULT_DISTANCE, OBJECT_RADIUS, Rig
from hyperplanes.data.formats.collections import AUTHORS_FOCAL
from hyperplanes.data.formats.scenes.transforms_document import transforms_document
from hyperplanes.utilities.axes import flip_camera_axes
from hyperplanes.utilities.files.encoding import encode_json, encode_npz, encode_png

__all__ = ["LAYOUTS", "Layout", "RenderedObject", "check_names"]


@dataclass(frozen=True)
class RenderedObject:
    """An object with its pictures.

    Attributes:
        item: which object.
        rig: its cameras.
        rgba: uint8 (view, height, width, 4), straight alpha.
        channels: float32 arrays by name (depth, normals, coordinates).
        model: GLB bytes of the normalised mesh, or None.
        mesh: the normalised mesh.
    """

    item: Item
    rig: Rig
    rgba: npt.NDArray[np.uint8]
    channels: dict[str, npt.NDArray[np.float32]] = field(default_factory=dict)
    model: bytes | None = None
    mesh: Any = None


@dataclass(frozen=True)
class Layout:
    """A file layout.

    Attributes:
        files: makes an object's files, relative path to bytes.
        splits: makes the files that state the splits of the objects (in order).
        planes: near and far of the layout's loaders in their world units, by part of the class name; "" for all others.
            None if they read them from the files.
        field_of_view: in degrees that the layout's loaders assume, or None.
        resolution: in pixels that they assume, or None.
        scale: their world units per unit of ours.
        classes: the classes that the loaders know, or None for any.
    """

    files: Callable[[RenderedObject], dict[str, bytes]]
    splits: Callable[[Sequence[Item]], dict[str, bytes]] = lambda _: {}
    planes: dict[str, tuple[float, float]] | None = None
    field_of_view: float | None = None
    resolution: int | None = None
    scale: float = 1.0
    classes: tuple[str, ...] | None = None

    def near_far(self, class_name: str | None) -> tuple[float, float] | None:
        """Near and far of the loaders for a class, in our world units; None if they read them from the files."""
        if self.planes is None:
            return None
        part = next((part for part in self.planes if part and part in (class_name or "")), "")
        near, far = self.planes[part]
        return near / self.scale, far / self.scale

    def distance(self, class_name: str | None) -> float:
        """Distance of the cameras from the origin: the middle of the loaders' depth range."""
        planes = self.near_far(class_name)
        return DEFAULT_DISTANCE if planes is None else sum(planes) / 2


def native(rendered: RenderedObject) -> dict[str, bytes]:
    """NAME/transforms.json with nerfstudio's fields, NAME/images/000.png (RGBA, straight alpha) and so on.

    Other channels are NAME/depth.npz, normals.npz, coordinates.npz, one float32 array under the channel's name each,
    and NAME/mesh.glb.
    """
    name, rig = rendered.item.name, rendered.rig
    names = [f"images/{index:03d}.png" for index in range(len(rig))]
    files = {f"{name}/{path}": encode_png(pixels) for path, pixels in zip(names, rendered.rgba, strict=True)}
    for channel, values in sorted(rendered.channels.items()):
        files[f"{name}/{channel}.npz"] = encode_npz({channel: values})
    if rendered.model is not None:
        files[f"{name}/mesh.glb"] = rendered.model
    document = transforms_document(
        rig.world_from_camera,
        rig.intrinsics,
        (rig.height, rig.width),
        names,
        near_far=(rig.near, rig.far),
        sphere=((0.0, 0.0, 0.0), OBJECT_RADIUS),
    )
    files[f"{name}/transforms.json"] = encode_json(document)
    return files


def learnit(rendered: RenderedObject) -> dict[str, bytes]:
    """CLASSs/NAME/transforms.json and CLASSs/NAME/r_000.png and so on, as in the data of learned initialisations.

    The JSON has camera_angle_x and the frames' OpenGL poses; pictures are RGBA with straight alpha beside it. Loaders
    assume near 2 and far 6. CLASS_splits.json beside the class folder lists the names (Tancik et al., 2021).
    """
    _check_lens(rendered.rig, "learnit-128", centred=True)
    item, rig = rendered.item, rendered.rig
    folder = f"{_plural(item)}/{item.name}"
    names = [f"./r_{index:03d}" for index in range(len(rig))]
    full = transforms_document(rig.world_from_camera, rig.intrinsics, (rig.height, rig.width), names, alternating=False)
    document = {"camera_angle_x": full["camera_angle_x"], "frames": full["frames"]}
    files = {f"{folder}/r_{index:03d}.png": encode_png(pixels) for index, pixels in enumerate(rendered.rgba)}
    files[f"{folder}/transforms.json"] = encode_json(document)
    return files


def learnit_splits(items: Sequence[Item]) -> dict[str, bytes]:
    """CLASS_splits.json for every class: {"train": [names], "val": [...], "test": [...]}."""
    files = {}
    for singular in sorted({item.class_name or "mesh" for item in items}):
        chosen = [item for item in items if (item.class_name or "mesh") == singular]
        splits = {split: [item.name for item in chosen if item.split == split] for split in ("train", "val", "test")}
        files[f"{singular}_splits.json"] = encode_json(splits)
    return files


def hyperplanes(rendered: RenderedObject) -> dict[str, bytes]:
    """CLASSs/sampled/VIEWS_NAME.npz for the loaders of HyperPlanes, MultiPlaneNeRF and points2nerf.

    `images` float32 (view, 200, 200, 3) in [0, 1] over white, `cam_poses` float32 (view, 4, 4) OpenGL camera-to-world.
    Their loaders assume a focal length of 277.77 pixels, near 2 and far 6, and split the files sorted by name 80/20.
    Read by `hyperplanes.data` and ignored by theirs: `rgba` uint8 with straight alpha, `focal` in pixels. Underscores
    in names become hyphens, because their loaders take what follows the last underscore as the name.
    """
    _check_lens(rendered.rig, "hyperplanes-200", centred=True)
    item, rig = rendered.item, rendered.rig
    arrays = {
        "images": over_white(rendered.rgba).astype(np.float32) / np.float32(255),
        "cam_poses": (flip_camera_axes(rig.world_from_camera) + 0.0).astype(np.float32),
        "rgba": rendered.rgba,
        "focal": np.float64(rig.intrinsics[0, 0, 0]),
    }
    return {f"{_plural(item)}/sampled/{len(rig)}_{_hyphenated(item.name)}.npz": encode_npz(arrays)}


def check_names(layout: str, names: Sequence[str]) -> None:
    """Refuse objects to which a layout would give the same name.

    Raises:
        ValueError: two names differ only in hyphens and underscores, in the layout hyperplanes-200.
    """
    if layout != "hyperplanes-200":
        return
    taken: dict[str, str] = {}
    for name in names:
        other = taken.setdefault(_hyphenated(name), name)
        if other != name:
            raise ValueError(f"{name}: expected a name that {layout} tells from {other}, whose _ become -; rename one")


def _hyphenated(name: str) -> str:
    return name.replace("_", "-")


def srn(rendered: RenderedObject) -> dict[str, bytes]:
    """CLASSs_SPLIT/NAME with intrinsics.txt, rgb/000000.png and pose/000000.txt (Sitzmann et al., 2019).

    Poses are OpenCV camera-to-world, 16 numbers in a line, in a world half the size of ours, to fit the depth range
    of pixel-nerf's loader: 0.8 to 1.8, and 1.25 to 2.75 for the class chair. intrinsics.txt: focal length and
    principal point (half-pixel centres); the centre of the scene; near plane; scale; height and width. Pictures are RGB
    over white: the format has no alpha.
    """
    _check_lens(rendered.rig, "srn", centred=False)
    item, rig = rendered.item, rendered.rig
    folder = f"{_plural(item)}_{item.split}/{item.name}"
    matrix = rig.intrinsics[0]
    lines = [
        f"{float(matrix[0, 0])!r} {float(matrix[0, 2]) + 0.5!r} {float(matrix[1, 2]) + 0.5!r} 0.",
        "0. 0. 0.",
        "0.",
        "1.",
        f"{rig.height} {rig.width}",
    ]
    files = {f"{folder}/intrinsics.txt": ("\n".join(lines) + "\n").encode()}
    white = over_white(rendered.rgba)
    for index, pixels in enumerate(white):
        pose = rig.world_from_camera[index].copy()
        pose[:3, 3] *= LAYOUTS["srn"].scale
        files[f"{folder}/rgb/{index:06d}.png"] = encode_png(pixels)
        files[f"{folder}/pose/{index:06d}.txt"] = (" ".join(repr(float(x)) for x in pose.ravel()) + "\n").encode()
    return files


def over_white(rgba: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Straight-alpha pixels (..., 4) over white, rounded to 8 bits.

    >>> over_white(np.array([0, 255, 0, 51], np.uint8)).tolist()
    [204, 255, 204]
    """
    alpha = rgba[..., 3:].astype(np.uint32)
    return ((rgba[..., :3] * alpha + 255 * (255 - alpha) + 127) // 255).astype(np.uint8)


def _check_lens(rig: Rig, layout: str, *, centred: bool) -> None:
    """Refuse intrinsics that a layout with a single focal length, and possibly no principal point, cannot store."""
    middle = np.array([[rig.width - 1, rig.height - 1]]) / 2
    lens, where = rig.intrinsics, "one focal length for both axes and all views"
    wrong = np.abs(lens - lens[0]).max() > 1e-6 or abs(lens[0, 0, 0] - lens[0, 1, 1]) > 1e-6
    if centred and not wrong:
        where, wrong = "a principal point in the middle of the picture", np.abs(lens[:, :2, 2] - middle).max() > 1e-6
    if wrong:
        fx, fy, x, y = lens[0, 0, 0], lens[0, 1, 1], lens[0, 0, 2] + 0.5, lens[0, 1, 2] + 0.5
        raise ValueError(
            f"layout {layout}: expected {where}, as it stores no other, got focal lengths {fx:g}, {fy:g} and the point "
            f"{x:g}, {y:g} of {rig.width} x {rig.height}; take the native layout"
        )


def _plural(item: Item) -> str:
    return f"{item.class_name or 'mesh'}s"


LAYOUTS: dict[str, Layout] = {
    "native": Layout(native),
    "learnit-128": Layout(learnit, learnit_splits, planes={"": (2.0, 6.0)}),
    "hyperplanes-200": Layout(
        hyperplanes,
        planes={"": (2.0, 6.0)},
        field_of_view=float(np.degrees(2 * np.arctan(100 / AUTHORS_FOCAL))),
        resolution=200,
        classes=("car", "chair", "plane"),
    ),
    "srn": Layout(srn, planes={"": (0.8, 1.8), "chair": (1.25, 2.75)}, scale=0.5),
}
"""Layouts by their names on the command line."""
