"""Build, select, move, resize and place batches of Kornia pinhole cameras.

Conventions of the whole package: OpenCV axes (x right, y down, z forward), extrinsics are camera_from_world, pixel
(0, 0) is centred at (0, 0), so that a centred principal point is ((W - 1) / 2, (H - 1) / 2). Every function returns a
new `PinholeCamera` with storage (view, 4, 4); none changes its argument. `look_at`, `orbit`, `fibonacci_sphere` and the
conversions of axes of `poses` can be imported from here, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.inputs import Selection, as_selection, check_precision
from hyperplanes.geometry.lookup_torch import MIN_Z
from hyperplanes.geometry.poses import fibonacci_sphere, look_at, opencv_from_opengl, opengl_from_opencv, orbit
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.precision import without_autocast

__all__ = [
    "ROTATION_TOLERANCE",
    "camera_from_world",
    "centres",
    "concatenate",
    "cropped",
    "fibonacci_sphere",
    "image_size",
    "intrinsics",
    "least_depth",
    "look_at",
    "moved",
    "opencv_from_opengl",
    "opengl_from_opencv",
    "orbit",
    "pinhole",
    "projection_matrices",
    "resized",
    "select",
    "camera_directions",
    "symmetric_intrinsics",
    "to",
    "viewing_directions",
    "with_poses",
]

ROTATION_TOLERANCE = 1e-3


@checked
@without_autocast
def pinhole(
    intrinsics: Float[Tensor, "*view 3 3"],
    camera_from_world: Float[Tensor, "view 4 4"],
    height: int,
    width: int,
) -> PinholeCamera:
    """A checked batch of pinhole cameras that share one image size.

    Kornia's constructor validates little; wrong numbers are refused here.

    Args:
        intrinsics: calibration in pixels with integer pixel centres, one (3, 3) matrix or one a view.
        camera_from_world: rigid transforms in OpenCV axes.
        height: rows of the images.
        width: columns of the images.

    Returns:
        Cameras with storage (view, 4, 4), dtype and device of `camera_from_world`.

    Raises:
        ValueError: a shape, a value that is not finite, a focal length that is not positive, or a block that is not
            a rotation.

    >>> cameras = pinhole(symmetric_intrinsics(64, 64, 0.7), torch.eye(4)[None], 64, 64)
    >>> cameras.project(torch.tensor([[[0.0, 0.0, 2.0]]])).flatten().tolist()
    [31.5, 31.5]
    """
    pose = camera_from_world
    if pose.ndim != 3 or pose.shape[1:] != (4, 4):
        raise ValueError(f"camera_from_world: expected shape (view, 4, 4), got {tuple(pose.shape)}")
    if intrinsics.shape[-2:] != (3, 3) or intrinsics.ndim not in (2, 3):
        raise ValueError(f"intrinsics: expected shape (3, 3) or (view, 3, 3), got {tuple(intrinsics.shape)}")
    views = pose.shape[0]
    if intrinsics.ndim == 3 and intrinsics.shape[0] not in (1, views):
        raise ValueError(f"intrinsics: expected one matrix or {views}, one a pose, got {intrinsics.shape[0]}")
    _check_size(height, width)
    calibration = intrinsics.to(pose).expand(views, 3, 3)
    with torch.no_grad():
        _check_numbers(calibration, pose)
    full = torch.eye(4, dtype=pose.dtype, device=pose.device).repeat(views, 1, 1)
    full = torch.cat([torch.cat([calibration, full[:, :3, 3:]], dim=2), full[:, 3:]], dim=1)
    size = torch.ones(views, dtype=_size_dtype(pose.dtype), device=pose.device)
    return PinholeCamera(full, pose, size * height, size * width)


def _check_size(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise ValueError(f"image size: expected at least 1 x 1, got {height} x {width}")


def _size_dtype(dtype: torch.dtype) -> torch.dtype:
    """The dtype of heights and widths: half precision would round them from 257 (bfloat16) or 2,049 pixels on."""
    return torch.promote_types(dtype, torch.float32)


def _check_numbers(calibration: Tensor, pose: Tensor) -> None:
    for name, values in (("intrinsics", calibration), ("camera_from_world", pose)):
        bad = (~torch.isfinite(values)).flatten(1).any(1).nonzero().flatten().tolist()
        if bad:
            raise ValueError(f"{name}: expected finite numbers, got NaN or infinity in view {bad[0]}")
    focal = torch.stack([calibration[:, 0, 0], calibration[:, 1, 1]], -1)
    if (focal <= 0).any():
        view = int((focal <= 0).any(-1).nonzero()[0])
        raise ValueError(f"intrinsics: expected positive focal lengths, got {focal[view].tolist()} in view {view}")
    rotation = pose[:, :3, :3] if pose.element_size() > 2 else pose[:, :3, :3].float()  # det has no half precision
    identity = torch.eye(3, dtype=rotation.dtype, device=pose.device)
    error = (rotation @ rotation.mT - identity).abs().flatten(1).amax(1)
    wrong = (error > ROTATION_TOLERANCE) | (torch.linalg.det(rotation) < 0)
    if wrong.any():
        view = int(wrong.nonzero()[0])
        raise ValueError(
            f"camera_from_world: expected a rotation in the upper left 3 x 3 block, got one in view {view} with "
            f"|R R^T - I| = {float(error[view]):.3g} and determinant {float(torch.linalg.det(rotation[view])):.3g}"
        )
    last = pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    if ((pose[:, 3] - last).abs() > ROTATION_TOLERANCE).any():
        raise ValueError("camera_from_world: expected the last row 0 0 0 1")


@checked
def symmetric_intrinsics(height: int, width: int, field_of_view: float) -> Float[Tensor, "3 3"]:
    """Calibration of a camera that looks through its image centre.

    Args:
        height: rows.
        width: columns.
        field_of_view: horizontal opening angle in radians, measured from image border to image border, so that
            f = W / (2 tan(angle / 2)).

    Returns:
        float32 matrix with square pixels and principal point ((W - 1) / 2, (H - 1) / 2).

    Raises:
        ValueError: an angle outside (0, pi).

    >>> symmetric_intrinsics(4, 4, math.pi / 2)[0].tolist()
    [2.0, 0.0, 1.5]
    """
    if not 0 < field_of_view < math.pi:
        raise ValueError(f"field_of_view: expected radians in (0, pi), got {field_of_view}")
    focal = width / (2 * math.tan(field_of_view / 2))
    return torch.tensor([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


def intrinsics(cameras: PinholeCamera) -> Float[Tensor, "view 3 3"]:
    """The calibration matrices in pixels, integer pixel centres."""
    return cameras.intrinsics[:, :3, :3]


def camera_from_world(cameras: PinholeCamera) -> Float[Tensor, "view 4 4"]:
    """The rigid transforms, OpenCV axes."""
    return cameras.extrinsics


def image_size(cameras: PinholeCamera) -> tuple[int, int]:
    """(height, width) in pixels, shared by the batch.

    Raises:
        ValueError: cameras of different image sizes, or no camera.
    """
    sizes = {(int(h), int(w)) for h, w in zip(cameras.height.tolist(), cameras.width.tolist(), strict=True)}
    if len(sizes) != 1:
        raise ValueError(f"cameras: expected one image size, got {sorted(sizes) or 'no camera'}")
    return sizes.pop()


@without_autocast
def projection_matrices(cameras: PinholeCamera) -> Float[Tensor, "view 3 4"]:
    """K [R | t]: homogeneous pixels from world."""
    return intrinsics(cameras) @ camera_from_world(cameras)[:, :3]


@without_autocast
def centres(cameras: PinholeCamera) -> Float[Tensor, "view 3"]:
    """Optical centres in the world: -R^T t."""
    pose = camera_from_world(cameras)
    return -(pose[:, :3, :3].mT @ pose[:, :3, 3:]).squeeze(-1)


def camera_directions(cameras: PinholeCamera, centre: tuple[float, float, float]) -> Float[Tensor, "view 3"]:
    """Unit vectors from a point, such as the centre of a scene, to the cameras; zero for a camera at the point.

    >>> camera = pinhole(torch.eye(3), look_at(torch.tensor([[0.0, 0.0, 3.0]])), 1, 1)
    >>> camera_directions(camera, (0.0, 0.0, 1.0)).int().tolist()
    [[0, 0, 1]]
    """
    standing = centres(cameras)
    return torch.nn.functional.normalize(standing - standing.new_tensor(centre), dim=-1)


def least_depth(cameras: PinholeCamera) -> float:
    """The least depth at which a point counts as in front of a camera, in world units.

    It is MIN_Z times the mean distance of the cameras from their centroid, so that a scene gives the same picture in
    metres and in micrometres. Cameras in one place do not tell the size of their scene: for them it is the rounding
    error of their distance from the world's origin, or MIN_Z if they stand there.

    >>> round(least_depth(pinhole(torch.eye(3), orbit(4, 2.0, 0.0), 1, 1)), 6)
    0.0002
    """
    if not cameras.batch_size:
        return MIN_Z
    standing = centres(cameras).detach()
    eyes = standing.double()
    spread = float((eyes - eyes.mean(0)).norm(dim=-1).mean())
    distance = float(eyes.norm(dim=-1).mean())
    if spread > 1e-6 * distance:
        return MIN_Z * spread
    return 4 * torch.finfo(standing.dtype).eps * distance or MIN_Z


def viewing_directions(cameras: PinholeCamera) -> Float[Tensor, "view 3"]:
    """Unit optical axes in the world, pointing away from the camera (HyperPlanes, d_I)."""
    return camera_from_world(cameras)[:, 2, :3]


def _rebuilt(
    cameras: PinholeCamera, change: Callable[[Tensor], Tensor], change_size: Callable[[Tensor], Tensor] | None = None
) -> PinholeCamera:
    """The cameras with every tensor they hold changed, lenses included; heights and widths in another way, if given."""
    values = [change(value) for value in (cameras.intrinsics, cameras.extrinsics)]
    bare = PinholeCamera(*values, *((change_size or change)(value) for value in (cameras.height, cameras.width)))
    return DistortedCamera(bare, change(cameras.distortion)) if isinstance(cameras, DistortedCamera) else bare


def _with_lens_of(cameras: PinholeCamera, bare: PinholeCamera) -> PinholeCamera:
    """Pinhole cameras with the distortion of other ones, if these have any."""
    return DistortedCamera(bare, cameras.distortion) if isinstance(cameras, DistortedCamera) else bare


@checked
def select(cameras: PinholeCamera, index: Selection) -> PinholeCamera:
    """The cameras at `index`, in that order, or those for which it is True. An index out of range raises ValueError."""
    chosen = as_selection(index, cameras.batch_size, "cameras")
    return _rebuilt(cameras, lambda value: value[chosen])


def concatenate(batches: list[PinholeCamera]) -> PinholeCamera:
    """All cameras of several batches in one batch, with zero distortion for those without a lens if any has one.

    Raises:
        ValueError: an empty list.
    """
    if not batches:
        raise ValueError("batches: expected at least one batch of cameras, got none")
    bare = PinholeCamera(
        torch.cat([batch.intrinsics for batch in batches]),
        torch.cat([batch.extrinsics for batch in batches]),
        torch.cat([batch.height for batch in batches]),
        torch.cat([batch.width for batch in batches]),
    )
    if not any(isinstance(batch, DistortedCamera) for batch in batches):
        return bare
    lenses = [
        batch.distortion if isinstance(batch, DistortedCamera) else batch.intrinsics.new_zeros(batch.batch_size, 5)
        for batch in batches
    ]
    return DistortedCamera(bare, torch.cat(lenses))


@checked
def to(
    cameras: PinholeCamera, device: torch.device | str | None = None, dtype: torch.dtype | None = None
) -> PinholeCamera:
    """The cameras on another device or in another precision; sizes of pictures are in single precision at least.

    An integer type, which would round rotations to 0 and 1, raises ValueError.
    """
    check_precision(dtype)
    of_size = None if dtype is None else _size_dtype(dtype)
    return _rebuilt(
        cameras,
        lambda value: value.to(device=device, dtype=dtype),
        lambda value: value.to(device=device, dtype=of_size),
    )


@checked
def with_poses(cameras: PinholeCamera, camera_from_world: Float[Tensor, "view 4 4"]) -> PinholeCamera:
    """The cameras at other poses, with the same calibration and distortion."""
    bare = pinhole(intrinsics(cameras), camera_from_world, *image_size(cameras))
    return _with_lens_of(cameras, bare)


@checked
@without_autocast
def moved(cameras: PinholeCamera, motion: Float[Tensor, "4 4"]) -> PinholeCamera:
    """The cameras moved together with the world by a rigid motion (a float64 matrix)."""
    pose = camera_from_world(cameras)
    return with_poses(cameras, pose @ torch.linalg.inv(motion).to(pose))


@checked
def cropped(cameras: PinholeCamera, height: int, width: int) -> PinholeCamera:
    """The cameras of images whose right and lower borders were moved; calibration and distortion stay.

    A size below one pixel raises ValueError.
    """
    _check_size(height, width)
    bare = PinholeCamera(
        cameras.intrinsics,
        cameras.extrinsics,
        torch.full_like(cameras.height, height),
        torch.full_like(cameras.width, width),
    )
    return _with_lens_of(cameras, bare)


@checked
def resized(cameras: PinholeCamera, height: int, width: int) -> PinholeCamera:
    """The cameras of the same images scaled to another size.

    The image borders, not the pixel centres, stay in place: c' = s (c + 1/2) - 1/2, which is not what
    `PinholeCamera.scale` does. A size below one pixel raises ValueError.

    >>> small = pinhole(symmetric_intrinsics(64, 64, 0.7), torch.eye(4)[None], 64, 64)
    >>> intrinsics(resized(small, 128, 128))[0, :2, 2].tolist()
    [63.5, 63.5]
    """
    _check_size(height, width)
    old_height, old_width = image_size(cameras)
    scale = cameras.intrinsics.new_tensor([width / old_width, height / old_height])
    matrix = cameras.intrinsics.clone()
    matrix[:, :2, :2] = matrix[:, :2, :2] * scale[:, None]
    matrix[:, :2, 2] = scale * (matrix[:, :2, 2] + 0.5) - 0.5
    bare = PinholeCamera(
        matrix, cameras.extrinsics, torch.full_like(cameras.height, height), torch.full_like(cameras.width, width)
    )
    return _with_lens_of(cameras, bare)
