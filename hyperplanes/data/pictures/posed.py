"""Posed 8-bit images, which all readers return and which become float `Views`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, UInt8
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.data.pictures.bounds import ONE_PLACE, estimate_bounds, inverted
from hyperplanes.data.pictures.images import check_downscale, composite_over_white, reduced
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.messages.errors import listed
from hyperplanes.views import Task, Views

__all__ = ["Posed", "PosedTask", "check_pose", "posed"]

MAX_EXTENTS = 1e3  # of a scene: its largest distance from the origin at which float32 is exact to 0.1 pixels


@dataclass(frozen=True)
class Posed:
    """Images and cameras of one scene, compact enough to keep many in memory.

    Attributes:
        rgba: with straight (not premultiplied) alpha, 255 if the files have none.
        cameras: one per image, OpenCV axes, integer pixel centres.
        has_alpha: whether the alpha channel holds masks.
        stated_bounds: the sphere that the files state, or None.
        names: of the image files, relative to the folder of the scene.
        depths: (view, 2), the nearest and farthest distance that the files state, or None.
        notes: messages for the user about what was left out, rotated or scaled, one sentence each.
        up: as in `Views`.
        origin: origin of this world, in the world of the files.
    """

    rgba: UInt8[Tensor, "view 4 height width"]
    cameras: PinholeCamera
    has_alpha: bool
    stated_bounds: Sphere | None
    names: tuple[str, ...]
    depths: Float[Tensor, "view 2"] | None = None
    notes: tuple[str, ...] = ()
    up: str | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def bounds(self) -> Sphere:
        """The sphere around the scene: the stated one, otherwise an estimate from these views."""
        if self.stated_bounds is not None:
            return self.stated_bounds
        return estimate_bounds(self.cameras, self.rgba[:, 3:] if self.has_alpha else None, self.depths)

    def __len__(self) -> int:
        return len(self.rgba)

    def views(self) -> Views:
        """The float images over white, with masks if the files have alpha."""
        images, masks = composite_over_white(self.rgba)
        return Views(images, self.cameras, masks if self.has_alpha else None, self.bounds, self.names, self.up)

    def select(self, index: list[int]) -> Posed:
        """The images at `index`, in that order. Bounds that are not stated are estimated from these images alone."""
        return replace(
            self,
            rgba=self.rgba[index],
            cameras=camera.select(self.cameras, index),
            names=tuple(self.names[i] for i in index),
            depths=None if self.depths is None else self.depths[index],
        )

    def downscaled(self, factor: int | None) -> Posed:
        """The images reduced by averaging blocks of factor x factor pixels; None leaves them as they are."""
        if factor is None or factor == 1:
            return self
        check_downscale(factor, (self.rgba.shape[2], self.rgba.shape[3]), self.names[0])
        height, width = self.rgba.shape[2] // factor, self.rgba.shape[3] // factor
        pictures = [reduced(picture, factor) for picture in self.rgba.permute(0, 2, 3, 1).numpy()]
        whole = camera.cropped(self.cameras, height * factor, width * factor)
        return replace(
            self,
            rgba=torch.from_numpy(np.ascontiguousarray(np.stack(pictures).transpose(0, 3, 1, 2))),
            cameras=camera.resized(whole, height, width),
            notes=(*self.notes, f"scaled down by {factor}, to {width} x {height} pixels"),
        )

    @property
    def nbytes(self) -> int:
        """Memory of the images in bytes."""
        return self.rgba.nbytes


@dataclass(frozen=True)
class PosedTask:
    """The support and query images of one object.

    Attributes:
        support: images that a method is given.
        query: images that its result is compared with, disjoint from the support.
        name: of the object.
    """

    support: Posed
    query: Posed
    name: str

    def task(self) -> Task:
        """The same as float views."""
        return Task(self.support.views(), self.query.views(), self.name)

    @property
    def nbytes(self) -> int:
        """Memory of the images in bytes."""
        return self.support.nbytes + self.query.nbytes

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the user, as in `Posed`."""
        return self.support.notes

    @classmethod
    def split(cls, scene: Posed, support: list[int], query: list[int], name: str) -> PosedTask:
        """Some views of a scene as support and others as query. Estimated bounds depend on the support alone."""
        shown = scene.select(support)
        return cls(shown, replace(scene.select(query), stated_bounds=shown.bounds), name)

    @classmethod
    def halves(cls, scene: Posed, name: str) -> PosedTask:
        """The first half of the views as support, the rest as query."""
        index = list(range(len(scene)))
        return cls.split(scene, index[: len(index) // 2], index[len(index) // 2 :], name)

    @classmethod
    def alternating(cls, scene: Posed, name: str) -> PosedTask:
        """Every other view, beginning with the first, as support, the rest as query; DataError for a single view."""
        if len(scene) < 2:
            remedy = "add views, or use `render --all-views`, which needs no query views"
            raise DataError(name, "two views or more", f"{len(scene)}", remedy)
        index = list(range(len(scene)))
        return cls.split(scene, index[::2], index[1::2], name)

    def downscaled(self, factor: int | None) -> PosedTask:
        """Both halves as `Posed.downscaled`."""
        return PosedTask(self.support.downscaled(factor), self.query.downscaled(factor), self.name)


def posed(
    pictures: list[npt.NDArray[np.uint8]],
    camera_from_world: npt.NDArray[np.float64],
    intrinsics: npt.NDArray[np.float64],
    *,
    has_alpha: bool,
    bounds: Sphere | None,
    names: tuple[str, ...],
    source: str | Path,
    depths: Float[Tensor, "view 2"] | None = None,
    notes: tuple[str, ...] = (),
) -> Posed:
    """The scene made of what a reader found.

    Support and query of a scene are passed in one call, because they share a world. If the scene lies so far from its
    origin that float32 is not accurate enough, as with map coordinates, a rounded offset is subtracted from its cameras
    and bounds in float64, and stated in the notes.

    Args:
        pictures: (height, width, 4) each, all of one size.
        camera_from_world: (view, 4, 4), OpenCV axes, already checked.
        intrinsics: (view, 3, 3) in pixels, integer pixel centres.
        has_alpha: whether the alpha channel holds masks.
        bounds: of the scene, or None to estimate them.
        names: one per image.
        source: the file, for messages.
        depths: nearest and farthest distance of what each image shows, or None.
        notes: as in `Posed`.

    Returns:
        The scene.

    Raises:
        DataError: an invalid calibration.
    """
    rgba = torch.from_numpy(np.ascontiguousarray(np.stack(pictures).transpose(0, 3, 1, 2)))
    height, width = rgba.shape[2:]
    offset = _far_offset(camera_from_world, bounds)
    x, y, z = offset.tolist()
    if offset.any():
        camera_from_world = camera_from_world.copy()
        camera_from_world[:, :3, 3] += camera_from_world[:, :3, :3] @ offset
        if bounds is not None:
            centre = bounds.centre
            bounds = Sphere((centre[0] - x, centre[1] - y, centre[2] - z), bounds.radius)
        notes = (*notes, f"the world is shifted for float32 precision: new origin ({x:.10g}, {y:.10g}, {z:.10g})")
    if has_alpha and (wrong := inverted(rgba[:, 3:]).nonzero()[:, 0].tolist()):
        which = f"masks of {len(wrong)} of {len(names)} images ({listed([names[index] for index in wrong])})"
        notes = (*notes, f"{which} seem to show the background; invert them, white is the object")
    offset = np.abs(intrinsics[:, :2, 2] - [(width - 1) / 2, (height - 1) / 2])
    if outside := [name for name, (x, y) in zip(names, offset, strict=True) if x > width / 2 or y > height / 2]:
        where = f"the principal point lies outside the image: {listed(outside)}"
        notes = (*notes, f"{where}; check cx and cy unless these are crops")
    try:
        cameras = camera.pinhole(
            torch.from_numpy(intrinsics).float(), torch.from_numpy(camera_from_world).float(), height, width
        )
    except ValueError as error:
        raise DataError(source, "usable cameras", str(error), "export the cameras again") from error
    return Posed(rgba, cameras, has_alpha, bounds, names, depths, notes, origin=(x, y, z))


def _far_offset(camera_from_world: npt.NDArray[np.float64], bounds: Sphere | None) -> npt.NDArray[np.float64]:
    """The offset to subtract from a world far from its origin, otherwise 0.

    It is rounded, so that most folders of one world get the same offset.
    """
    rotation, translation = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3:]
    centres = -(rotation.transpose(0, 2, 1) @ translation)[..., 0]
    middle = np.median(centres, axis=0)
    extent = max(float(np.abs(centres - middle).max()), 0.0 if bounds is None else bounds.radius)
    far = float(np.abs(middle).max())
    if far <= MAX_EXTENTS * extent or extent <= ONE_PLACE * far:
        return np.zeros(3)
    step = 2.0 ** (math.floor(math.log2(far)) - 14)
    return np.round(middle / step) * step + 0.0


def check_pose(matrix: object, source: str | Path, frame: str) -> npt.NDArray[np.float64]:
    """The rigid (4, 4) transform that a file states.

    Args:
        matrix: nested lists or an array, (3, 4) or (4, 4).
        source: the file, for messages.
        frame: the frame in the file, for messages.

    Returns:
        The transform in float64.

    Raises:
        DataError: another shape, a value that is not finite, a 3 x 3 block that is not a rotation, or another last row
            than 0, 0, 0, 1.
    """
    where = f"{source}, frame {frame}"
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(where, "a 4 x 4 pose of numbers", str(error), "export the poses again") from error
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if pose.shape != (4, 4):
        raise DataError(where, "a 4 x 4 pose", f"shape {pose.shape}", "export the poses again")
    if not np.isfinite(pose).all():
        raise DataError(where, "a pose of finite numbers", "NaN or infinity", "export the poses again")
    rotation = pose[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if max(np.abs(pose[3] - [0, 0, 0, 1]).max(), error) > camera.ROTATION_TOLERANCE or determinant < 0:
        found = f"|R R^T - I| = {error:.2g}, determinant {determinant:.3g}, last row {pose[3].tolist()}"
        raise DataError(where, "a rotation and a translation", found, "take scale and mirroring out of the poses")
    return pose
