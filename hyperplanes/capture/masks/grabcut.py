"""Masks by GrabCut, which segments by colour and edges, from sparse points or from masks to be completed.

Rother, Kolmogorov and Blake, "GrabCut: interactive foreground extraction using iterated graph cuts", SIGGRAPH 2004.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

from hyperplanes.capture.masks.regions import cleaned, firm
from hyperplanes.capture.packages import require
from hyperplanes.capture.placement import object_points, object_sphere
from hyperplanes.capture.sparse_model import SparseModel
from hyperplanes.utilities.images.sizes import scaled_size

__all__ = ["GrabCut", "extended"]

MAX_IMAGE_SIZE = 320  # pixels along the longer side of the images that are segmented
SEED_RADIUS = 0.012  # of the longer side: radius of the disc that is labelled around a point
GRABCUT_ITERATIONS = 5
CERTAIN_DEPTH = 0.03  # of the square root of a mask's area: pixels further inside than this surely belong to the object


class GrabCut:
    """Masks of the region whose colours resemble those at the sparse points that `object_points` selects.

    Args:
        model: of structure from motion. The images must be undistorted.
    """

    def __init__(self, model: SparseModel) -> None:
        self._cv2 = require("cv2", "finds masks by GrabCut")
        self._model = model
        self._chosen = object_points(model, None)
        self._sphere = object_sphere(model, self._chosen)

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], camera: int) -> Float[np.ndarray, "height width"]:
        """Opacity in [0, 1]."""
        size = scaled_size(picture.shape[1::-1], MAX_IMAGE_SIZE)
        labels = self._seeds(camera, size, max(size) / max(picture.shape[:2]))
        if not (labels == self._cv2.GC_FGD).any():
            return np.zeros(picture.shape[:2])
        return cleaned(_cut(picture, labels))

    def _seeds(self, camera: int, size: tuple[int, int], scale: float) -> np.ndarray:
        """GrabCut's initial labels: certain around points and outside the object's sphere, otherwise probable."""
        width, height = size
        labels = np.full((height, width), self._cv2.GC_BGD, np.uint8)
        (x, y), distance = self._model.project(camera, np.array([self._sphere.centre]))
        focal = self._model.calibrations[camera, 0, 0] * scale
        reach = focal * self._sphere.radius / np.sqrt(max(float(distance[0]) ** 2 - self._sphere.radius**2, 1e-9))
        middle = ((x[0] + 0.5) * scale, (y[0] + 0.5) * scale)
        rows, columns = np.mgrid[:height, :width] + 0.5
        from_middle = np.hypot(columns - middle[0], rows - middle[1])
        labels[from_middle < reach] = self._cv2.GC_PR_BGD
        labels[from_middle < 0.5 * reach] = self._cv2.GC_PR_FGD
        seen = self._model.observed[self._model.observed[:, 0] == camera, 1]
        radius = max(1, round(SEED_RADIUS * max(size)))
        for chosen, label in ((False, self._cv2.GC_BGD), (True, self._cv2.GC_FGD)):
            points = self._model.points[seen[self._chosen[seen] == chosen]]
            places, front = self._model.project(camera, points)
            for column, row in ((places + 0.5) * scale - 0.5).T[front > 0]:
                self._cv2.circle(labels, (round(column), round(row)), radius, int(label), -1)
        return labels


def extended(
    picture: UInt8[np.ndarray, "height width 3"],
    mask: Float[np.ndarray, "height width"],
    possible: Bool[np.ndarray, "row column"],
) -> Float[np.ndarray, "height width"]:
    """A mask, extended by GrabCut with pixels that resemble it.

    Args:
        picture: 8-bit RGB.
        mask: opacity in [0, 1], which is lowered nowhere.
        possible: the pixels that may belong to the object, in any resolution.

    Returns:
        Opacity in [0, 1].
    """
    cv2 = require("cv2", "completes masks by colour")
    size = scaled_size(picture.shape[1::-1], MAX_IMAGE_SIZE)
    likely, allowed = (np.asarray(_resized(values, size) > 0.5) for values in (mask, possible))
    depth = max(1, round(CERTAIN_DEPTH * float(np.sqrt(likely.sum()))))
    certain = np.asarray(ndimage.binary_erosion(likely, iterations=depth), bool)
    labels = np.full(certain.shape, cv2.GC_BGD)
    for where, label in ((allowed, cv2.GC_PR_BGD), (likely, cv2.GC_PR_FGD), (certain, cv2.GC_FGD)):
        labels[where] = label
    if not (certain.any() and (labels == cv2.GC_PR_BGD).any()):
        return mask
    return np.maximum(mask, _cut(picture, labels.astype(np.uint8), 2))


def _cut(picture: np.ndarray, labels: np.ndarray, steps: int = GRABCUT_ITERATIONS) -> np.ndarray:
    """Opacity of the image by GrabCut, from initial labels in a lower resolution."""
    cv2 = require("cv2", "finds masks by GrabCut")
    small = np.asarray(Image.fromarray(picture).resize(labels.shape[::-1], Image.Resampling.BOX))
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    labels, _, _ = cv2.grabCut(small, labels, None, *models, steps, cv2.GC_INIT_WITH_MASK)
    height, width = picture.shape[:2]
    return firm(_resized(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)), (width, height)))


def _resized(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    scaled = Image.fromarray(values.astype(np.float32)).resize(size, Image.Resampling.BICUBIC)
    return np.asarray(scaled, np.float64)
