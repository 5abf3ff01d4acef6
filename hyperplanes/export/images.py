"""Export of fields as images and turntables."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import Renderable
from hyperplanes.data.pictures.images import PICTURE_SUFFIXES
from hyperplanes.export.animation import choose_representation
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.occupancy import carve
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.reading import format_of
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.images.image_range import check_image_range
from hyperplanes.utilities.images.sizes import scaled_size
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.messages.errors import MissingPackageError
from hyperplanes.views import Views

__all__ = [
    "TURNTABLE_FORMATS",
    "encode_animation",
    "orbit_cameras",
    "picture_paths",
    "require_encoder",
    "save_images",
    "save_turntable",
    "to_pixels",
    "upward",
]

TURNTABLE_FORMATS = ("webp", "gif", "mp4", "webm")
FRAMING_HULL_SIDE = 48  # voxels an axis of the hull that must fit into an orbit's pictures
FRAMING_MARGIN = 0.02  # free share of a side
CODECS = {
    "mp4": {"codec": "libx264", "quality": 8},
    # same quality (44.3 and 44.5 dB on the views of example-car); this encoder ignores imageio-ffmpeg's quality
    "webm": {"codec": "libvpx-vp9", "quality": None, "output_params": ["-crf", "10", "-b:v", "0"]},
}


FASTEST = 20
"""Shortest duration of a frame of an animation, in milliseconds; browsers slow down faster ones."""


@checked
def to_pixels(images: Float[Tensor, "view 3 height width"]) -> npt.NDArray[np.uint8]:
    """Images in [0, 1] as 8-bit pixels (view, height, width, 3); values outside are clamped.

    >>> to_pixels(torch.tensor([-1.0, 0.5, 2.0]).reshape(1, 3, 1, 1)).tolist()
    [[[[0, 128, 255]]]]
    """
    return (images.detach().clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()


@checked
def encode_animation(frames: npt.NDArray[np.uint8], kind: str = "webp", seconds: float = 4.0) -> bytes:
    """An endless animation, or a video, which needs imageio-ffmpeg: the extra `video`.

    Args:
        frames: (frame, height, width, 3) pixels.
        kind: "webp" or "gif"; "mp4" or "webm" for a video.
        seconds: duration of one round. Frames of animations last at least 20 ms, since browsers slow down faster ones:
            more than 50 frames a second take longer. Videos have any frame rate.

    Returns:
        The file.

    Raises:
        ValueError: another kind, or no frame.
    """
    from PIL import Image

    if kind not in TURNTABLE_FORMATS:
        raise ValueError(f"kind: expected one of {', '.join(TURNTABLE_FORMATS)}, got {kind!r}")
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or not frames.size:
        raise ValueError(
            f"frames: expected 8-bit pixels (frame, height, width, 3), got {frames.dtype} {frames.shape}; "
            "`to_pixels` converts images"
        )
    if not 0 < seconds < math.inf:
        raise ValueError(f"seconds: expected a time above 0, got {seconds}")
    if kind in CODECS:
        repeats = math.ceil(seconds / len(frames))  # players expect at least one frame a second
        return _video(frames.repeat(repeats, axis=0), kind, repeats * len(frames) / seconds)
    first, *others = [Image.fromarray(frame) for frame in frames]
    how = {"quality": 90, "method": 4} if kind == "webp" else {}
    buffer = io.BytesIO()
    unit = 10 if kind == "gif" else 1  # unit of durations in milliseconds
    ends = [unit * round(1000 * seconds * (index + 1) / len(frames) / unit) for index in range(len(frames))]
    duration = [max(FASTEST, end - begin) for begin, end in pairwise([0, *ends])]
    first.save(buffer, kind.upper(), save_all=True, append_images=others, duration=duration, loop=0, **how)
    return buffer.getvalue()


def require_encoder(kind: str) -> None:
    """Check, before frames are rendered, that an animation can be encoded here.

    Args:
        kind: as in `encode_animation`.

    Raises:
        MissingPackageError: a video without imageio-ffmpeg.
    """
    if kind in CODECS and find_spec("imageio_ffmpeg") is None:
        missing = f"{kind}: expected the package imageio-ffmpeg, found none; pip install 'hyperplanes[video]'"
        raise MissingPackageError(missing)


def _video(frames: npt.NDArray[np.uint8], kind: str, rate: float) -> bytes:
    """A video of `rate` frames a second; odd sizes get one more row or column by repetition."""
    require_encoder(kind)
    from imageio_ffmpeg import write_frames

    height, width = frames.shape[1:3]
    even = np.pad(frames, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"video.{kind}"
        size = (even.shape[2], even.shape[1])
        how: dict[str, Any] = {**CODECS[kind], "fps": rate, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        writer = write_frames(str(path), size, **how)
        writer.send(None)
        for frame in even:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        return path.read_bytes()


@checked
def save_images(
    images: Float[Tensor, "view 3 height width"], folder: str | Path, names: Sequence[str] = ()
) -> list[Path]:
    """Write each image as PNG.

    Args:
        images: RGB in [0, 1].
        folder: created if absent.
        names: file names, one an image; folders and the endings of image files are dropped. Numbers if absent or not
            distinct.

    Returns:
        The files. Another number of names, or values far outside [0, 1], are a ValueError.
    """
    check_image_range("images", images)
    paths = picture_paths(len(images), Path(folder), names)
    for path, pixels in zip(paths, to_pixels(images), strict=True):
        write_whole(path, encode_png(pixels, small=True))
    return paths


def picture_paths(count: int, folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Paths of pictures: with the given names, or numbered where these are absent or not distinct.

    Args:
        count: number of pictures.
        folder: their folder.
        names: file names; folders and the endings of image files are dropped.

    Returns:
        Paths of PNGs.

    Raises:
        ValueError: another number of names than of pictures.
    """
    if names and len(names) != count:
        raise ValueError(f"names: expected {count}, one an image, got {len(names)}")
    paths = [Path(name) for name in names]
    stems = [path.stem if path.suffix.lower() in PICTURE_SUFFIXES else path.name for path in paths]
    if len(set(stems)) != count:
        stems = [f"{index:04d}" for index in range(count)]
    return [folder / f"{stem}.png" for stem in stems]


def upward(cameras: PinholeCamera) -> tuple[float, float, float]:
    """The world direction that is up in the pictures on average; +y where they do not agree.

    >>> upward(camera.pinhole(torch.eye(3), torch.eye(4)[None], 2, 2))
    (-0.0, -1.0, -0.0)
    """
    mean = -camera.camera_from_world(cameras)[:, 1, :3].mean(0)
    length = float(mean.norm())
    x, y, z = (mean / length).tolist() if length > 0.1 else (0.0, 1.0, 0.0)
    return x, y, z


@checked
def orbit_cameras(
    views: Views, count: int, *, size: int | None = None, elevation: float = math.radians(20.0)
) -> PinholeCamera:
    """Cameras on a level circle around the object, at the distance of the views and with the lens of one of them.

    Where the views have masks and no lens distortion, the cameras stand further back if the visual hull would not fit
    into their pictures, as after close-ups that crop the object.

    Args:
        views: posed images of the object.
        count: how many cameras.
        size: pixels along the longer side; that of the views where absent.
        elevation: above the horizon of `upward`, in radians.

    Returns:
        A batch of cameras, the first at the azimuth of the first view. Their lens is that of the view with the squarest
        pixels, since a portrait picture among landscape ones was scaled to their size.

    Raises:
        ValueError: a count or size below 1, or no views.
    """
    if not len(views):
        raise ValueError("views: expected at least one, for lens and distance, got none")
    if count < 1:
        raise ValueError(f"count: expected at least one camera, got {count}")
    if size is not None and size < 1:
        raise ValueError(f"size: expected at least 1 pixel, got {size}")
    cameras, centre = views.cameras, torch.tensor(views.bounds.centre)
    # the level circle: its direction towards the first view, and the one across
    positions = camera.centres(cameras).cpu().float() - centre
    up = torch.tensor(upward(cameras))
    front = positions[0] - (positions[0] @ up) * up
    if float(front.norm()) < 1e-6 * float(positions[0].norm()):
        front = torch.linalg.cross(up, up.roll(1))
    front = front / front.norm()
    side = torch.linalg.cross(up, front)
    angle = torch.arange(count) * (2 * math.pi / count)
    around = angle.cos()[:, None] * front + angle.sin()[:, None] * side
    # cameras on it, at the median distance of the views
    distance = float(positions.norm(dim=1).median())
    eyes = centre + distance * (math.cos(elevation) * around + math.sin(elevation) * up)
    x, y, z = up.tolist()
    pose = camera.look_at(eyes, views.bounds.centre, (x, y, z)).to(cameras.extrinsics)
    # the lens of the view with the squarest pixels
    focal = camera.intrinsics(cameras)[:, [0, 1], [0, 1]].log()
    squarest = int((focal[:, 0] - focal[:, 1]).abs().round(decimals=3).argmin())
    lens = camera.select(cameras, [squarest])
    batch = camera.with_poses(camera.select(lens, [0] * count), _stepped_back(pose, lens, views))
    if size is None:
        return batch
    return camera.resized(batch, *scaled_size(views.size, size, enlarge=True))


def _stepped_back(pose: Tensor, lens: PinholeCamera, views: Views) -> Tensor:
    """Poses (camera from world) moved back by one distance, so that the visual hull fits into the pictures."""
    if views.masks is None or isinstance(views.cameras, DistortedCamera):
        return pose
    hull = carve(views.masks, views.cameras, views.bounds, FRAMING_HULL_SIDE)
    points = hull.centres().to(pose)
    if not len(points):
        return pose
    matrix, (height, width) = camera.intrinsics(lens)[0].to(pose), camera.image_size(lens)
    seen = points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
    needed = seen.new_zeros(())
    for axis, side in ((0, width), (1, height)):
        focal, middle, margin = matrix[axis, axis], matrix[axis, 2], FRAMING_MARGIN * side
        before, after = middle - margin, side - 1 - margin - middle  # pixels to both borders
        for place, room in ((-seen[..., axis], before), (seen[..., axis], after)):
            if room > 0:
                needed = torch.maximum(needed, (place * focal / room - seen[..., 2]).max())
    moved = pose.clone()
    moved[:, 2, 3] += needed
    return moved


@checked
def save_turntable(
    field: Renderable, views: Views, path: str | Path, *, frames: int = 48, size: int | None = None
) -> Path:
    """Render one round around the object and write it as an animation.

    Args:
        field: what to render; a long round is rendered by voxels fitted to it (`animation.choose_representation`).
        views: its support views, which give lens, distance and up.
        path: ends in .webp, .gif, .mp4 or .webm.
        frames: number of frames.
        size: pixels along the longer side; that of the views where absent.

    Returns:
        The file. Another ending is a ValueError.
    """
    path = Path(path)
    kind = format_of(path, TURNTABLE_FORMATS)
    cameras = orbit_cameras(views, frames, size=size)
    pictures = choose_representation(field, views, cameras).render(cameras)
    write_whole(path, encode_animation(to_pixels(pictures.images), kind))
    return path
