"""Images of renderer outputs, under nerfstudio's names: rgb, depth, normals, accumulation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from kornia.geometry.camera import PinholeCamera

from hyperplanes.export.images import picture_paths, to_pixels
from hyperplanes.rendering.depth import seen_surface
from hyperplanes.rendering.images import Pictures
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.writing import write_json, write_whole
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["OUTPUTS", "depth_pixels", "output_frames", "save_outputs"]

OUTPUTS = ("rgb", "depth", "normals", "accumulation")
"""The outputs."""

NEAREST_VALUE, FARTHEST_VALUE = 2**14, 2**16 - 1
"""Pixel values of depth; the nearest is a quarter of white, distinct from 0 for empty pixels."""


def depth_pixels(z: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.uint16], float, float]:
    """Depth as 16-bit pixels: 0 where there is none, else 16384 to 65535 from the nearest to the farthest of all views.

    Args:
        z: (view, height, width), 0 where there is none.

    Returns:
        The pixels, the nearest depth and the farthest: z = nearest + (pixel - 16384) / 49151 * (farthest - nearest).

    >>> pixels, nearest, farthest = depth_pixels(np.array([[[0.0, 2.0, 3.0]]], np.float32))
    >>> pixels.tolist(), nearest, farthest
    ([[[0, 16384, 65535]]], 2.0, 3.0)
    """
    seen = z > 0
    if not seen.any():
        return np.zeros(z.shape, np.uint16), 0.0, 0.0
    nearest, farthest = float(z[seen].min()), float(z[seen].max())
    scaled = (z.astype(np.float64) - nearest) / (farthest - nearest or 1.0)
    return (
        np.where(seen, NEAREST_VALUE + np.round(scaled * (FARTHEST_VALUE - NEAREST_VALUE)), 0).astype(np.uint16),
        nearest,
        farthest,
    )


@checked
def output_frames(name: str, pictures: Pictures, cameras: PinholeCamera) -> npt.NDArray[np.uint8]:
    """One output as 8-bit colours (view, height, width, 3), for animations.

    Args:
        name: one of OUTPUTS.
        pictures: of a field.
        cameras: their cameras.
    """
    pixels, _ = _pixels(name, pictures, cameras)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    return pixels if pixels.ndim == 4 else np.repeat(pixels[..., None], 3, -1)


@checked
def save_outputs(
    outputs: Sequence[str], pictures: Pictures, cameras: PinholeCamera, folder: str | Path, names: Sequence[str] = ()
) -> list[Path]:
    """Write a PNG for each view and output: rgb into the folder, others into subfolders of their names.

    Depth is the coordinate along the optical axis in 16 bits, as `depth_pixels` says, with the nearest and the farthest
    in depth.json; normals are (n + 1) / 2 of unit vectors in the world, white where there is no surface;
    accumulation is opacity.

    Args:
        outputs: some of OUTPUTS.
        pictures: of a field.
        cameras: their cameras.
        folder: created if absent.
        names: as in `save_images`.

    Returns:
        The pictures. Another number of names than of views is a ValueError.
    """
    written = []
    for output in outputs:
        pixels, stated = _pixels(output, pictures, cameras)
        place = Path(folder) if output == "rgb" else Path(folder) / output
        for path, each in zip(picture_paths(len(pixels), place, names), pixels, strict=True):
            write_whole(path, encode_png(each, small=each.dtype == np.uint8))
            written.append(path)
        if stated:
            write_json(place / f"{output}.json", stated)
    return written


def _pixels(name: str, pictures: Pictures, cameras: PinholeCamera) -> tuple[npt.NDArray, dict[str, float]]:
    """The pixels of an output, and the numbers needed to read them.

    Raises:
        ValueError: an unknown output.
    """
    if name not in OUTPUTS:
        raise ValueError(f"outputs: expected some of {', '.join(OUTPUTS)}, got {name!r}")
    if name == "rgb":
        return to_pixels(pictures.images), {}
    if name == "accumulation":
        return (pictures.opacity[:, 0].clamp(0, 1) * 255).round().byte().cpu().numpy(), {}
    surface = seen_surface(pictures, cameras)
    if name == "depth":
        pixels, nearest, farthest = depth_pixels(surface.z.cpu().numpy())
        return pixels, {"nearest": nearest, "farthest": farthest}
    shown = surface.covered[..., None]
    return to_pixels((shown * (surface.normals + 1) / 2 + 1 - shown).permute(0, 3, 1, 2)), {}
