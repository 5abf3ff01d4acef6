"""The result of structure from motion: cameras, and points on the surfaces that they see."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from hyperplanes.utilities.files.encoding import encode_npz
from hyperplanes.utilities.files.reading import DataError, malformed
from hyperplanes.utilities.files.writing import write_whole

__all__ = ["SparseModel"]


@dataclass(frozen=True)
class SparseModel:
    """Cameras, and points that several of them observe.

    Attributes:
        pictures: index of the image of each camera.
        camera_from_world: (camera, 4, 4), OpenCV axes.
        calibrations: (camera, 3, 3) in pixels, integer pixel centres.
        lenses: (camera, 2), the radial coefficients k1 and k2.
        points: (point, 3) in the world.
        colours: (point, 3), RGB with 8 bits.
        errors: (point,), mean reprojection error in pixels.
        observed: (observation, 2), the index of a camera and that of a point that it observes.
    """

    pictures: Int[np.ndarray, " camera"]
    camera_from_world: Float[np.ndarray, "camera 4 4"]
    calibrations: Float[np.ndarray, "camera 3 3"]
    lenses: Float[np.ndarray, "camera 2"]
    points: Float[np.ndarray, "point 3"]
    colours: UInt8[np.ndarray, "point 3"]
    errors: Float[np.ndarray, " point"]
    observed: Int[np.ndarray, "observation 2"]

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def centres(self) -> Float[np.ndarray, "camera 3"]:
        """Camera centres in the world."""
        rotation, translation = self.camera_from_world[:, :3, :3], self.camera_from_world[:, :3, 3:]
        return -(rotation.transpose(0, 2, 1) @ translation)[..., 0]

    @property
    def reprojection_error(self) -> float:
        """Mean reprojection error over all observations, in pixels; NaN without observations."""
        if not len(self.observed):
            return float("nan")
        return float(self.errors[self.observed[:, 1]].mean())

    def errors_of_cameras(self) -> list[float]:
        """Mean reprojection error of the points that each camera observes, in pixels; NaN if it observes none."""
        with np.errstate(invalid="ignore"):
            count = np.bincount(self.observed[:, 0], minlength=len(self))
            total = np.bincount(self.observed[:, 0], self.errors[self.observed[:, 1]], len(self))
            return (total / count).tolist()

    def project(
        self, camera: int, points: Float[np.ndarray, "point 3"]
    ) -> tuple[Float[np.ndarray, "2 point"], Float[np.ndarray, " point"]]:
        """Pixel coordinates (x, y) of points, without lens distortion, and their z in the camera's frame.

        Args:
            camera: index of the camera.
            points: in the world. The pixel coordinates mean nothing for points with z <= 0.
        """
        local = points @ self.camera_from_world[camera, :3, :3].T + self.camera_from_world[camera, :3, 3]
        seen = local @ self.calibrations[camera].T
        return (seen[:, :2] / np.where(seen[:, 2:] > 1e-9, seen[:, 2:], 1.0)).T, local[:, 2]

    def moved(self, new_from_old: Float[np.ndarray, "4 4"]) -> SparseModel:
        """The same model in another world.

        Args:
            new_from_old: a similarity: a rotation times one scale, and a translation.
        """
        scale = float(np.cbrt(np.linalg.det(new_from_old[:3, :3])))
        rotation = new_from_old[:3, :3] / scale
        poses = self.camera_from_world.copy()
        poses[:, :3, :3] = self.camera_from_world[:, :3, :3] @ rotation.T
        poses[:, :3, 3] = scale * self.camera_from_world[:, :3, 3] - poses[:, :3, :3] @ new_from_old[:3, 3]
        return replace(self, camera_from_world=poses, points=self.points @ new_from_old[:3, :3].T + new_from_old[:3, 3])

    def save(self, path: str | Path) -> None:
        """Write an .npz file, atomically."""
        write_whole(path, encode_npz({each.name: getattr(self, each.name) for each in fields(self)}))

    @classmethod
    def load(cls, path: str | Path) -> SparseModel:
        """The model that `save` wrote; raises DataError for any other file."""
        try:
            with malformed(path, "a sparse model"), np.load(path, allow_pickle=False) as arrays:
                return cls(**{each.name: arrays[each.name] for each in fields(cls)})
        except FileNotFoundError as error:
            raise DataError(path, "a sparse model", "nothing", "find the poses again") from error
