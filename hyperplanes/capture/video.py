"""Extract frames from a video: the sharpest of each interval."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from hyperplanes.capture.packages import require
from hyperplanes.utilities.files.encoding import encode_jpeg
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.writing import write_whole

__all__ = ["sharpness", "take_frames"]

FRAMES_PER_INTERVAL = 5  # frames of each interval, of which the sharpest is taken
JPEG_QUALITY = 95  # of JPEG
SHARPNESS_SIZE = 320  # pixels along the longer side, at which sharpness is measured
MIN_RELATIVE_SHARPNESS = 0.25  # of the median sharpness: frames with less are left out


def take_frames(path: Path, folder: Path, count: int, progress: Callable[[str, int, int, str], None]) -> int:
    """Divide a video into `count` intervals and write the sharpest frame of each as a JPEG file.

    Args:
        path: the video.
        folder: in which the frames are written, as frame_0000.jpg and so on.
        count: number of intervals.
        progress: called during the work.

    Returns:
        The number of frames written. Frames with less than a quarter of the median sharpness are left out.

    Raises:
        DataError: a file that is not a video, or a video with too few frames.
    """
    reader = require("imageio_ffmpeg", "reads videos")
    try:
        frames = reader.read_frames(str(path))
        about = next(frames)
    except (OSError, RuntimeError, StopIteration, KeyError) as error:
        said = (str(error).splitlines() or ["no frames"])[-1].strip()
        raise DataError(path, "a video", f"something else ({said})", "export it again") from error
    total = max(1, round(about["duration"] * about["fps"]))
    if total < 3 or not count >= 3:
        frames.close()
        raise DataError(path, "a video of some seconds", f"{total} frames", "film once around the object")
    wanted = {round(index) for index in np.linspace(0, total - 1, min(total, count * FRAMES_PER_INTERVAL))}
    stretch = total / min(count, total)
    best: dict[int, tuple[float, bytes]] = {}
    for index, picture in enumerate(_pictures(frames, about["size"])):
        if index not in wanted:
            continue
        progress("frames", min(index, total), total, path.name)
        slot, value = int(index / stretch), sharpness(picture)
        if slot not in best or value > best[slot][0]:
            best[slot] = value, encode_jpeg(picture, JPEG_QUALITY)
    if not best:
        raise DataError(path, "a video with frames that can be read", "none", "export it again")
    least = MIN_RELATIVE_SHARPNESS * float(np.median([value for value, _ in best.values()]))
    kept = [data for _, (value, data) in sorted(best.items()) if value >= least]
    for index, data in enumerate(kept):
        write_whole(folder / f"frame_{index:04d}.jpg", data, durable=False)
    progress("frames", total, total, f"{len(kept)} kept")
    return len(kept)


def sharpness(picture: np.ndarray) -> float:
    """Variance of the Laplacian of a small greyscale copy of an image. Motion blur lowers it.

    Args:
        picture: (height, width, 3), 8 bits.
    """
    small = Image.fromarray(picture).convert("L")
    small.thumbnail((SHARPNESS_SIZE, SHARPNESS_SIZE))
    return float(ndimage.laplace(np.asarray(small, np.float64)).var())


def _pictures(frames: Iterator[bytes], size: tuple[int, int]) -> Iterator[np.ndarray]:
    for data in frames:
        yield np.frombuffer(data, np.uint8).reshape(size[1], size[0], 3)
