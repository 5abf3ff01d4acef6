"""Write a scene as nerfstudio does: transforms.json, images/, masks/ and the sparse points."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from hyperplanes.capture.scene_record import SceneRecord
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.data.formats.scenes.transforms_document import transforms_document
from hyperplanes.data.pictures.undistort import undistort
from hyperplanes.utilities.files.encoding import encode_ply
from hyperplanes.utilities.files.writing import write_json, write_whole
from hyperplanes.utilities.messages.formatting import counted

__all__ = ["Captured", "straightened", "write_scene"]

POINT_CLOUD_FILE = "sparse_pc.ply"
STRAIGHT = 0.25  # pixels: images whose corners the distortion moves less than this are not undistorted


@dataclass(frozen=True)
class Captured:
    """A scene that was written.

    Attributes:
        folder: of the scene.
        count: number of images.
        points: number of points that structure from motion found.
        error: mean reprojection error in pixels.
        mask: name of the method that found the masks.
        up_from: from what the up direction was determined.
        notes: messages for the user, one sentence each, such as what was left out.
    """

    folder: Path
    count: int
    points: int
    error: float
    mask: str = "none"
    up_from: str = ""
    notes: tuple[str, ...] = ()


def straightened(
    picture: UInt8[np.ndarray, "height width 3"],
    opacity: UInt8[np.ndarray, "height width"] | None,
    calibration: Float[np.ndarray, "3 3"],
    lens: Float[np.ndarray, " 2"],
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"] | None]:
    """An undistorted image and its mask, as a pinhole camera with the same calibration would have taken them.

    Args:
        picture: the image.
        opacity: its mask, or None.
        calibration: of its camera, integer pixel centres.
        lens: the radial coefficients k1 and k2.

    Returns:
        The image and its mask. Where the lens did not see, the border of the image is repeated, and the mask is 0.
        Distortion of less than a quarter of a pixel in the corners is ignored.
    """
    height, width = picture.shape[:2]
    corner = np.array([width, height]) / 2 / calibration[[0, 1], [0, 1]]
    square = float(corner @ corner)
    if abs(lens[0] * square + lens[1] * square**2) * np.hypot(width, height) / 2 < STRAIGHT:
        return picture, opacity
    coefficients = (float(lens[0]), float(lens[1]), *(0.0,) * 6)
    opaque = np.dstack([picture, np.full((height, width), 255, np.uint8)])
    straight = undistort(opaque, calibration, coefficients, opaque=True)[..., :3]
    if opacity is None:
        return straight, None
    return straight, undistort(np.dstack([picture, opacity]), calibration, coefficients)[..., 3]


def write_scene(
    record: SceneRecord,
    sources: Collection[str],
    model: SparseModel,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    files: dict[str, bytes],
) -> Captured:
    """Write the files of a scene, transforms.json last.

    Args:
        record: of the scene. Images and masks that an earlier transforms.json in it lists are deleted, except for masks
            that were changed since they were written.
        sources: the checksums of the photographs.
        model: in a world with z up, in which the unit sphere contains the object.
        names: of the images without suffix, one per camera.
        sizes: (height, width) of each image.
        files: the encoded images, and masks if there are any, by their paths in the folder.

    Returns:
        A summary of the scene, with a note if masks were kept.
    """
    folder, kept = record.folder, record.changed(files)
    written = {name: data for name, data in files.items() if name not in kept}
    former = record.listed() - set(files) - set(kept)
    record.begin(sources, written)
    (folder / "transforms.json").unlink(missing_ok=True)
    for name in former:
        if (folder / name).is_file():
            (folder / name).unlink()
    if not any(name.startswith("masks/") for name in files):
        with suppress(OSError):  # a folder that is absent, or holds other files
            (folder / "masks").rmdir()
    for name, data in written.items():
        write_whole(folder / name, data, durable=False)
    write_whole(folder / POINT_CLOUD_FILE, encode_ply(model.points, model.colours), durable=False)
    world_from_camera = np.linalg.inv(model.camera_from_world)
    paths = [f"images/{name}.jpg" for name in names]
    document = transforms_document(
        world_from_camera, model.calibrations, sizes[0], paths, sphere=((0.0, 0.0, 0.0), 1.0), alternating=False
    )
    for frame, name, size in zip(document["frames"], names, sizes, strict=True):
        if size != sizes[0]:
            frame["h"], frame["w"] = size
        if f"masks/{name}.png" in files:
            frame["mask_path"] = f"masks/{name}.png"
    write_json(folder / "transforms.json", document | {"up": "z", "ply_file_path": POINT_CLOUD_FILE})
    record.finish(sources, written)
    note = f"kept {counted(len(kept), 'mask')} that {'was' if len(kept) == 1 else 'were'} changed by hand; delete "
    note += f"{'it' if len(kept) == 1 else 'them'} to have {'it' if len(kept) == 1 else 'them'} made again"
    return Captured(folder, len(names), len(model.points), model.reprojection_error, notes=(note,) if kept else ())
