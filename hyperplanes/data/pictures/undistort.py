"""Undistort images: OpenCV's radial and tangential distortion, removed by resampling."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt
import torch
from torch.nn.functional import grid_sample

from hyperplanes.geometry.distortion import inverse_distortion, turning_radius
from hyperplanes.utilities.files.reading import DataError

__all__ = ["COEFFICIENTS", "check_lens", "distort", "undistort"]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's names, in OpenCV's order."""

GRID = 41  # points per axis at which the lens is checked
MOST_FOLDED = 0.02  # of them; polynomials fitted to the corners often fold just inside these

Array = npt.NDArray[np.float64]


def distort(points: Array, coefficients: tuple[float, ...]) -> Array:
    """Where the lens moves points (point, 2) of the image plane z = 1 (OpenCV, calib3d, rational model).

    >>> distort(np.array([[1.0, 0.0]]), (0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)).tolist()
    [[1.1, 0.0]]
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = points[:, 0], points[:, 1]
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def check_lens(matrix: Array, coefficients: tuple[float, ...], size: tuple[int, ...], source: object) -> None:
    """Raise an error if a lens folds: if it maps no direction, or several, to part of the image.

    Args:
        matrix: (3, 3) calibration, integer pixel centres.
        coefficients: of COEFFICIENTS.
        size: (height, width).
        source: the file and the frame, for the message.

    Raises:
        DataError: more than 2 % of the image are beyond the fold.
    """
    folded = _folded(tuple(matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()), tuple(coefficients), tuple(size))
    if folded > MOST_FOLDED:
        stated = ", ".join(f"{n} = {v:g}" for n, v in zip(COEFFICIENTS, coefficients, strict=True) if v)
        raise DataError(
            str(source),
            "a lens that maps one direction to each pixel",
            f"{stated}, which folds {folded:.0%} of the image",
            "calibrate again, or undistort the images first",
        )


@functools.lru_cache(64)  # frames of one camera share a lens, although files repeat it
def _folded(calibration: tuple[float, ...], coefficients: tuple[float, ...], size: tuple[int, ...]) -> float:
    """The share of the image to which no direction, or several, are mapped; `calibration` is fx, fy, cx, cy."""
    focal, centre = np.array(calibration[:2]), np.array(calibration[2:])
    rows, columns = (np.linspace(-0.5, extent - 0.5, GRID) for extent in size)
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    points = torch.from_numpy((pixels - centre) / focal)
    lens = torch.tensor([coefficients], dtype=torch.float64)
    limit = turning_radius(lens)
    tolerance = 0.01 / float(focal.max())
    _, found = inverse_distortion(points, lens.expand(len(points), -1), limit.expand(len(points)), tolerance)
    return 1 - float(found.double().mean())


def undistort(
    picture: npt.NDArray[np.uint8], matrix: Array, coefficients: tuple[float, ...], *, opaque: bool = False
) -> npt.NDArray[np.uint8]:
    """The image that a pinhole camera with the same calibration would have taken.

    Args:
        picture: (height, width, 4), straight alpha.
        matrix: (3, 3) calibration, integer pixel centres.
        coefficients: of COEFFICIENTS.
        opaque: for an image without alpha: where the lens did not see, repeat the border of the image instead of making
            pixels transparent.

    Returns:
        (height, width, 4) with straight alpha, interpolated bilinearly with premultiplied alpha.
    """
    height, width = picture.shape[:2]
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    focal, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2]
    ideal = (np.stack([columns, rows], -1).reshape(-1, 2) - centre) / focal
    limit = float(turning_radius(torch.tensor([coefficients], dtype=torch.float64)))
    radius = np.hypot(*ideal.T)
    beyond = radius >= limit  # where the polynomial folds, the lens sees nothing
    ideal[beyond] *= (limit / radius[beyond])[:, None]
    pixels = distort(ideal, coefficients) * focal + centre
    if not opaque:
        pixels[beyond] = -2.0  # outside the image
    grid = pixels / [max(width - 1, 1) / 2, max(height - 1, 1) / 2] - 1
    straight = torch.from_numpy(picture.astype(np.float32)).permute(2, 0, 1)[None]
    premultiplied = torch.cat([straight[:, :3] * straight[:, 3:] / 255, straight[:, 3:]], 1)
    target = torch.from_numpy(grid.astype(np.float32)).reshape(1, height, width, 2)
    padding = "border" if opaque else "zeros"
    sampled = grid_sample(premultiplied, target, mode="bilinear", padding_mode=padding, align_corners=True)[0]
    colour = torch.where(sampled[3:] > 0, sampled[:3] * 255 / sampled[3:].clamp_min(1e-3), torch.zeros(()))
    result = torch.cat([colour, sampled[3:]]).clamp(0, 255).round().permute(1, 2, 0)
    return result.to(torch.uint8).numpy()
