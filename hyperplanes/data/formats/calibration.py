"""Calibrations from the numbers that apps write: focal lengths, principal point, Brown's distortion coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.pictures.frames import scaled_matrix
from hyperplanes.utilities.files.reading import DataError

__all__ = ["brown_lens", "calibrated", "calibration_matrix"]

_SAMPLES = 200  # radii at which the distortion is fitted
_LARGEST_ERROR = 1e-4  # of the fit, in focal lengths: a tenth of a pixel for a focal length of 1,000 pixels


def calibration_matrix(focal: Sequence[float], centre: Sequence[float], source: str | Path) -> npt.NDArray[np.float64]:
    """The (3, 3) calibration, integer pixel centres.

    Args:
        focal: focal lengths along x and y in pixels.
        centre: principal point in pixels from the outer corner of the first pixel (half-pixel centres).
        source: the file, for the message.

    Returns:
        The matrix in float64.

    Raises:
        DataError: numbers that are not finite, or a focal length that is not positive.

    >>> calibration_matrix((40, 40), (15, 10), "cameras.xml")[0].tolist()
    [40.0, 0.0, 14.5]
    """
    numbers = [float(value) for value in (*focal, *centre)]
    if not np.isfinite(numbers).all() or min(numbers[:2]) <= 0:
        found = ", ".join(f"{value:g}" for value in numbers)
        raise DataError(source, "positive focal lengths and a principal point", found, "export the cameras again")
    return np.array([[numbers[0], 0.0, numbers[2] - 0.5], [0.0, numbers[1], numbers[3] - 0.5], [0.0, 0.0, 1.0]])


def calibrated(
    focal: Sequence[float], centre: Sequence[float], size: tuple[int, int], source: str | Path
) -> Callable[[tuple[int, int]], npt.NDArray[np.float64]]:
    """`Frame.calibrate` for a file that states the (height, width) of its images; as `calibration_matrix`."""
    if min(size) < 1:
        raise DataError(source, "a positive width and height", f"{size[1]} x {size[0]}", "export the cameras again")
    return partial(scaled_matrix, calibration_matrix(focal, centre, source), size)


def brown_lens(
    radial: Sequence[float], tangential: Sequence[float], reach: float, source: str | Path
) -> tuple[float, ...]:
    """OpenCV's eight distortion coefficients of a lens with up to four radial coefficients.

    OpenCV's model has no term in r^8. If k4 is not 0, its quotient of two cubic polynomials in r^2 is fitted to
    1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, up to the corner of the image.

    Args:
        radial: k1, k2, k3, k4.
        tangential: p1 and p2 in OpenCV's order.
        reach: r at the farthest corner of the image, in focal lengths.
        source: the file, for the message.

    Returns:
        The coefficients in the order of `undistort.COEFFICIENTS`.

    Raises:
        DataError: numbers that are not finite, or distortion that such a quotient cannot fit.

    >>> brown_lens((0.1, 0.2, 0.3, 0), (0.01, 0.02), 1.0, "cameras.xml")
    (0.1, 0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0)
    """
    numbers = [float(value) for value in (*radial, *tangential, reach)]
    if not np.isfinite(numbers).all():
        raise DataError(source, "finite coefficients of the lens", "NaN or infinity", "export the cameras again")
    above, below = np.array(numbers[:3]), np.zeros(3)
    if numbers[3]:
        share = np.linspace(0, 1, _SAMPLES)[:, None] ** [2, 4, 6, 8]  # r^2, r^4, ... in units of the reach
        scale = reach ** np.array([2, 4, 6, 8])
        wanted = share @ (scale * numbers[:4])  # the radial factor minus 1
        unknown = np.concatenate([share[:, :3], -(1 + wanted[:, None]) * share[:, :3]], 1)
        fitted = np.linalg.lstsq(unknown, wanted, rcond=None)[0]
        quotient = (1 + share[:, :3] @ fitted[:3]) / (1 + share[:, :3] @ fitted[3:])
        error = np.abs(quotient - 1 - wanted) * share[:, 0] ** 0.5 * reach
        if not error.max() < _LARGEST_ERROR:
            found = f"k4 = {numbers[3]:g}, fitted to within {error.max():.1g} focal lengths"
            raise DataError(source, "distortion that OpenCV's model can fit", found, "calibrate with k1, k2, k3 only")
        above, below = fitted[:3] / scale[:3], fitted[3:] / scale[:3]
    return (*above[:2].tolist(), *numbers[4:6], above[2].item(), *below.tolist())
