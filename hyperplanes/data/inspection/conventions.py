"""Do the poses mean what the file says? Only with the right ones do silhouettes agree, and corners match.

Masks decide where there are some, otherwise corners of the pictures; what could not be checked is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.data.inspection.matches import Matches, match_pictures
from hyperplanes.data.inspection.silhouettes import coarse_hull, masks_tell, small_masks, with_object
from hyperplanes.geometry import cameras as camera
from hyperplanes.utilities.axes import flip_camera_axes
from hyperplanes.views import Views

__all__ = [
    "AS_DECLARED",
    "FEWEST_MATCHES",
    "LEAST_COVERAGE",
    "RANDOM",
    "Conventions",
    "check_conventions",
    "near_lines",
]

AS_DECLARED = "as declared"
CLEARLY = 0.15
LEAST_COVERAGE = 0.83  # of the masks by their hull: 0.86 to 0.95 with right poses, 0.24 to 0.80 with wrong ones
FEWEST_MATCHES = 30
FEWEST_VIEWS = 3  # two masks are silhouettes of a hull under nearly any poses
EPIPOLAR_TOLERANCE = 2.0  # pixels of 256 from the epipolar line
MATCHING, RANDOM = 0.6, 0.3  # of the matches are near with right poses, and at most that many with wrong ones


@dataclass(frozen=True)
class Conventions:
    """How well the pictures agree under each reading of the poses.

    Attributes:
        scores: by reading, from 0 to 1; empty where nothing can be compared. Of masks, their mean overlap
            (intersection over union) with the silhouettes of their own visual hull; of pictures, the fraction of
            matched corners within two pixels of their epipolar lines.
        best: the reading under which they agree best; "as declared" unless another one is clearly better.
        by: "masks" or "pictures".
        matches: how many corners were matched.
        coverage: how much of the masks their hull covers with the poses as declared.
        without: why it is not by masks.
    """

    scores: dict[str, float]
    best: str
    by: str = "masks"
    matches: int = 0
    coverage: float = 1.0
    without: str = "there are no masks"

    @property
    def consistent(self) -> bool:
        """Whether no other reading is clearly better, and the declared one is not impossible."""
        if not self.scores:
            return True
        possible = self.coverage >= LEAST_COVERAGE if self.by == "masks" else self.scores[AS_DECLARED] >= RANDOM
        return self.best == AS_DECLARED and possible

    def line(self) -> str:
        """One line for people."""
        if not self.scores:
            return f"conventions: not checked, {self.without}, and only {self.matches} corners could be matched"
        declared = self.scores[AS_DECLARED]
        others = max(score for name, score in self.scores.items() if name != AS_DECLARED)
        what, measure = (
            ("masks", "coarse hull's overlap")
            if self.by == "masks"
            else (f"{self.matches} matched corners of the pictures", "on their epipolar lines")
        )
        if self.best != AS_DECLARED:
            return (
                f"conventions: WRONG, the {what} agree with the poses as declared by {declared:.0%} only, but by "
                f"{self.scores[self.best]:.0%} if the poses are {self.best}; convert them, or correct the declaration"
            )
        if not self.consistent and self.by == "masks":
            return (
                f"conventions: WRONG, the hull of the masks covers {self.coverage:.0%} of them (with right poses "
                f"{LEAST_COVERAGE:.0%} or more), and no more under any reading that is tried; check that poses and "
                "pictures belong together"
            )
        if not self.consistent:
            return (
                f"conventions: WRONG, the {what} agree with the poses by {declared:.0%} only ({measure}), and under no "
                "reading that is tried; check that poses and pictures belong together"
            )
        if self.by == "pictures" and declared < MATCHING:
            return f"conventions: unclear, {declared:.0%} of the {what} are {measure}; inspect cameras.png"
        return (
            f"conventions: {what} agree with the poses ({measure} {declared:.0%}; under other readings of the poses "
            f"{others:.0%} at best)"
        )


@torch.no_grad()
def check_conventions(views: Views) -> Conventions:
    """Try the ways in which poses are commonly mistaken for others.

    Returns:
        The agreement under each reading of the poses: of the masks, or without masks of the pictures.
    """
    if views.masks is None:
        return _by_pictures(views, "there are no masks")
    if not masks_tell(views):
        return _by_pictures(views, "the masks do not tell object and background apart")
    views = with_object(views)
    if len(views) < FEWEST_VIEWS:
        return _by_pictures(views, f"fewer than {FEWEST_VIEWS} views are too few to compare masks")
    masks, cameras = small_masks(views)
    readings = {name: camera.with_poses(cameras, pose) for name, pose in _readings(cameras).items()}
    scores = {name: float(coarse_hull(masks, each).overlap(masks, each).mean()) for name, each in readings.items()}
    declared = readings[AS_DECLARED]
    coverage = coarse_hull(masks, declared).coverage(masks, declared)
    return Conventions(scores, _clearly_best(scores), coverage=coverage)


def _by_pictures(views: Views, without: str) -> Conventions:
    matches = match_pictures(views)
    if len(matches) < FEWEST_MATCHES:
        return Conventions({}, AS_DECLARED, "pictures", len(matches), without=without)
    scores = {name: near_lines(matches, pose) for name, pose in _readings(views.cameras).items()}
    return Conventions(scores, _clearly_best(scores), "pictures", len(matches))


def near_lines(matches: Matches, pose: Tensor) -> float:
    """The fraction of matches that are on their epipolar lines."""
    return float((matches.errors(pose) < EPIPOLAR_TOLERANCE).double().mean())


def _clearly_best(scores: dict[str, float]) -> str:
    best = max(scores, key=lambda name: scores[name])
    return best if scores[best] > scores[AS_DECLARED] + CLEARLY else AS_DECLARED


def _readings(cameras: PinholeCamera) -> dict[str, Tensor]:
    """camera_from_world under each suspicion about the file, which the reader took for OpenGL camera-to-world."""
    declared = camera.camera_from_world(cameras)
    written = camera.opengl_from_opencv(declared)  # as it stands in a transforms.json
    return {
        AS_DECLARED: declared,
        "in OpenCV axes (y down, z forward), not OpenGL's": _flip_rows(declared),
        "camera-from-world in OpenGL axes, not its inverse": _flip_rows(written),
        "camera-from-world in OpenCV axes, not OpenGL camera-to-world": written,
    }


def _flip_rows(camera_from_world: Tensor) -> Tensor:
    return flip_camera_axes(camera_from_world.mT).mT
