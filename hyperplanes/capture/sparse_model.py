"""What structure from motion finds: cameras, and points on the surfaces that they see."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from hyperplanes.utilities.encoding import encode_npz
from hyperplanes.utilities.files import DataError, malformed
from hyperplanes.utilities.writing import write_whole

__all__ = ["SparseModel"]


@dataclass(frozen=True)
class SparseModel:
    """Cameras that were found, and points that several of them see.

    Attributes:
        pictures: which of the pictures each camera belongs to.
        camera_from_world: (camera, 4, 4), OpenCV axes.
        calibrations: (camera, 3, 3) in pixels, integer pixel centres.
        lenses: (camera, 2), the radial coefficients k1 and k2.
        points: (point, 3) in the world.
        colours: (point, 3).
        errors: (point,) mean reprojection error in pixels.
        observed: (observation, 2): which camera sees which point.
        pixels: (observation, 2): where, (x, y) at integer pixel centres.
    """

    pictures: Int[np.ndarray, " camera"]
    camera_from_world: Float[np.ndarray, "camera 4 4"]
    calibrations: Float[np.ndarray, "camera 3 3"]
    lenses: Float[np.ndarray, "camera 2"]
    points: Float[np.ndarray, "point 3"]
    colours: UInt8[np.ndarray, "point 3"]
    errors: Float[np.ndarray, " point"]
    observed: Int[np.ndarray, "observation 2"]
    pixels: Float[np.ndarray, "observation 2"]

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def centres(self) -> Float[np.ndarray, "camera 3"]:
        """Where the cameras stand."""
        rotation, translation = self.camera_from_world[:, :3, :3], self.camera_from_world[:, :3, 3:]
        return -(rotation.transpose(0, 2, 1) @ translation)[..., 0]

    @property
    def reprojection_error(self) -> float:
        """Pixels, mean over the observations."""
        if not len(self.observed):
            return float("nan")
        return float(self.errors[self.observed[:, 1]].mean())

    def errors_of_cameras(self) -> list[float]:
        """The mean reprojection error of the points that each camera sees, in pixels; NaN of one that sees none."""
        with np.errstate(invalid="ignore"):
            count = np.bincount(self.observed[:, 0], minlength=len(self))
            total = np.bincount(self.observed[:, 0], self.errors[self.observed[:, 1]], len(self))
            return (total / count).tolist()

    def project(
        self, camera: int, points: Float[np.ndarray, "point 3"]
    ) -> tuple[Float[np.ndarray, "2 point"], Float[np.ndarray, " point"]]:
        """Where a camera without its lens shows points, (x, y), and their distance along its axis.

        Args:
            camera: its number.
            points: in the world. What is not in front has no place in the picture: look at the distance first.
        """
        local = points @ self.camera_from_world[camera, :3, :3].T + self.camera_from_world[camera, :3, 3]
        seen = local @ self.calibrations[camera].T
        return (seen[:, :2] / np.where(seen[:, 2:] > 1e-9, seen[:, 2:], 1.0)).T, local[:, 2]

    def moved(self, new_from_old: Float[np.ndarray, "4 4"]) -> SparseModel:
        """The same in another world.

        Args:
            new_from_old: a similarity: rotation times one scale, and a translation.
        """
        scale = float(np.cbrt(np.linalg.det(new_from_old[:3, :3])))
        rotation = new_from_old[:3, :3] / scale
        poses = self.camera_from_world.copy()
        poses[:, :3, :3] = self.camera_from_world[:, :3, :3] @ rotation.T
        poses[:, :3, 3] = scale * self.camera_from_world[:, :3, 3] - poses[:, :3, :3] @ new_from_old[:3, 3]
        return replace(self, camera_from_world=poses, points=self.points @ new_from_old[:3, :3].T + new_from_old[:3, 3])

    def save(self, path: str | Path) -> None:
        """Write a .npz, whole or not at all."""
        write_whole(path, encode_npz({each.name: getattr(self, each.name) for each in fields(self)}))

    @classmethod
    def load(cls, path: str | Path) -> SparseModel:
        """What `save` wrote; anything else is a DataError."""
        try:
            with malformed(path, "a sparse model"), np.load(path, allow_pickle=False) as arrays:
                return cls(**{each.name: arrays[each.name] for each in fields(cls)})
        except FileNotFoundError as error:
            raise DataError(path, "a sparse model", "nothing", "find the poses again") from error
