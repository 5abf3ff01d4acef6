"""Masks without a network: GrabCut, told by the sparse points what is object and what is background.

Rother, Kolmogorov and Blake, "GrabCut: interactive foreground extraction using iterated graph cuts", SIGGRAPH 2004.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from hyperplanes.capture.masks.regions import cleaned, firm
from hyperplanes.capture.packages import require
from hyperplanes.capture.placement import object_points, object_sphere
from hyperplanes.capture.sparse_model import SparseModel

__all__ = ["GrabCut"]

LONGEST = 320  # pixels on which the cut is made
SEED = 0.012  # radius of what a point marks, of the longer side
STEPS = 5


class GrabCut:
    """The region whose colours resemble those around the points near the place that the cameras look at.

    Args:
        model: of structure from motion, whose pictures have no lens any more.
    """

    def __init__(self, model: SparseModel) -> None:
        self._cv2 = require("cv2", "cuts masks out of pictures")
        self._model = model
        self._chosen = object_points(model, None)
        self._sphere = object_sphere(model, self._chosen)

    def __call__(self, picture: UInt8[np.ndarray, "height width 3"], camera: int) -> Float[np.ndarray, "height width"]:
        """Opacity in [0, 1]."""
        height, width = picture.shape[:2]
        scale = min(1.0, LONGEST / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        small = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
        labels = self._seeds(camera, size, scale)
        if not (labels == self._cv2.GC_FGD).any():
            return np.zeros((height, width))
        self._cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        labels, _, _ = self._cv2.grabCut(small, labels, None, *models, STEPS, self._cv2.GC_INIT_WITH_MASK)
        inside = np.isin(labels, (self._cv2.GC_FGD, self._cv2.GC_PR_FGD))
        opacity = Image.fromarray(inside.astype(np.float32)).resize((width, height), Image.Resampling.BICUBIC)
        return cleaned(firm(np.asarray(opacity, np.float64)))

    def _seeds(self, camera: int, size: tuple[int, int], scale: float) -> np.ndarray:
        """What is certain, and what is likely, for GrabCut: around each point, and outside of the object's sphere."""
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
        radius = max(1, round(SEED * max(size)))
        for chosen, label in ((False, self._cv2.GC_BGD), (True, self._cv2.GC_FGD)):
            points = self._model.points[seen[self._chosen[seen] == chosen]]
            (x, y), front = self._model.project(camera, points)
            for column, row in zip(x[front > 0] * scale, y[front > 0] * scale, strict=True):
                self._cv2.circle(labels, (round(column), round(row)), radius, int(label), -1)
        return labels
