"""Simulated photographs of an object on a table in a textured room, with known lens, exposures, blur and noise.

The y axis of the world points up, and the object lies within the unit sphere around the origin. The room and the table
are analytic. The object is an analytic ellipsoid, or a mesh that `data_gen` renders and that is composited over the
room.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from scipy import ndimage
from torch.nn.functional import grid_sample

from data_gen.meshes.mesh import Mesh, mesh_parts
from data_gen.rendering.mesh_renderer import MeshRenderer
from data_gen.rigs import Rig
from hyperplanes.geometry.distortion import inverse_distortion, turning_radius

__all__ = ["Staged", "stage", "walk_around"]

Array = Float[np.ndarray, "..."]

HALF_ROOM = 6.0  # distance from the origin to the walls of the room
AXES = np.array([0.75, 0.55, 0.5])  # semi-axes of the ellipsoid
LIGHT = np.array([0.4, 0.8, 0.45])  # direction towards the light
FOCAL = 1.15  # focal length as a multiple of the longer side
EXPOSURE = 0.12  # standard deviation of the logarithm of each photograph's brightness
BLUR = 0.5  # largest standard deviation of a photograph's blur, in pixels
NOISE = 0.01  # standard deviation of the noise of a grey pixel, for values in [0, 1]


@dataclass(frozen=True)
class Staged:
    """Simulated photographs with their true masks and cameras.

    Attributes:
        photographs: (height, width, 3) each, distorted as a camera saves them.
        masks: (height, width) each, distorted likewise; true where the object is.
        world_from_camera: (view, 4, 4), OpenCV axes.
        calibration: (3, 3) intrinsics, integer pixel centres.
        lens: the distortion coefficients k1 and k2.
    """

    photographs: list[UInt8[np.ndarray, "height width 3"]]
    masks: list[np.ndarray]
    world_from_camera: Array
    calibration: Array
    lens: tuple[float, float]

    def save(self, folder: Path) -> None:
        """Write the photographs as JPEG, named in their order."""
        folder.mkdir(parents=True, exist_ok=True)
        for index, picture in enumerate(self.photographs):
            Image.fromarray(picture).save(folder / f"photo_{index:03d}.jpg", quality=93)


def walk_around(
    count: int, seed: int, heights: tuple[float, ...] = (12.0, 35.0, 58.0)
) -> Float[np.ndarray, "view 4 4"]:
    """Poses of a hand-held camera that goes around the object once at each elevation, almost level.

    Args:
        count: total number of poses.
        seed: of the random deviations from the circles.
        heights: elevations of the rounds, in degrees.

    Returns:
        world_from_camera.
    """
    generator = np.random.default_rng(seed)
    poses = []
    for index in range(count):
        turn = 2 * np.pi * index * len(heights) / count + generator.normal(0, 0.03)
        height = np.deg2rad(heights[index * len(heights) // count] + generator.normal(0, 2))
        eye = (3.3 + generator.normal(0, 0.12)) * np.array(
            [np.cos(height) * np.sin(turn), np.sin(height), np.cos(height) * np.cos(turn)]
        )
        forward = generator.normal(0, 0.06, 3) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        roll = generator.normal(0, np.deg2rad(1.5))
        down = np.cross(forward, right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack(
            [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward], 1
        )
        pose[:3, 3] = eye
        poses.append(pose)
    return np.stack(poses)


def stage(
    poses: Float[np.ndarray, "view 4 4"],
    size: tuple[int, int],
    *,
    seed: int,
    mesh: Mesh | None = None,
    lens: tuple[float, float] = (-0.08, 0.02),
    samples: int = 2,
    octaves: int = 6,
) -> Staged:
    """Render the photographs.

    Args:
        poses: world_from_camera, OpenCV axes.
        size: (height, width) in pixels.
        seed: of textures, exposures, blur and noise.
        mesh: the object; None for an ellipsoid.
        lens: the distortion coefficients k1 and k2.
        samples: samples per pixel along each axis, for the room and the ellipsoid.
        octaves: octaves of the noise texture; fewer octaves have fewer fine details.
    """
    generator = np.random.default_rng(seed)
    texture = generator.random((32, 32, 32, 3)).astype(np.float32)
    height, width = size
    focal = FOCAL * max(size)
    calibration = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    drawn, floor = _drawn(mesh, poses, calibration, size)
    source = _lens_source(size, calibration, lens)
    rows, columns = np.mgrid[: height * samples, : width * samples]
    pixels = (np.stack([columns, rows], -1).reshape(-1, 2) + 0.5) / samples - 0.5
    slopes = _without_lens((pixels - calibration[:2, 2]) / calibration[[0, 1], [0, 1]], lens)
    photographs, masks = [], []
    for view, pose in enumerate(poses):
        some = slopes.reshape(height, samples, width, samples, 2)
        colour, mask = _seen(pose, some, texture, mesh is None, floor, octaves)
        if drawn is not None:
            over = _through_lens(drawn[view].astype(np.float32) / 255, source)
            colour = over[..., :3] + colour * (1 - over[..., 3:])
            mask = over[..., 3]
        colour = colour * np.exp(generator.normal(0, EXPOSURE))
        colour = ndimage.gaussian_filter(colour, (*(generator.uniform(0, BLUR),) * 2, 0))
        colour = colour + generator.normal(0, NOISE, colour.shape) * np.sqrt(colour.clip(0.02) / 0.5)
        photographs.append((colour.clip(0, 1) * 255).round().astype(np.uint8))
        masks.append(mask > 0.5)
    return Staged(photographs, masks, poses, calibration, lens)


def _drawn(
    mesh: Mesh | None, poses: Array, calibration: Array, size: tuple[int, int]
) -> tuple[np.ndarray | None, float]:
    """Premultiplied RGBA images of the mesh by pinhole cameras (None for an ellipsoid), and the height of the table."""
    if mesh is None:
        return None, -float(AXES[1])
    rig = Rig(poses, calibration, size[1], size[0], near=0.5, far=8.0)
    rgba = MeshRenderer().render(mesh_parts(mesh), rig).rgba
    assert rgba is not None
    alpha = rgba[..., 3:].astype(np.float32) / 255
    premultiplied = np.concatenate([(rgba[..., :3] * alpha).round().astype(np.uint8), rgba[..., 3:]], -1)
    lowest = min(float(part.vertices[:, 1].min()) for part in mesh_parts(mesh))
    return premultiplied, lowest


def _seen(pose: Array, slopes: Array, texture: Array, ball: bool, floor: float, octaves: int) -> tuple[Array, Array]:
    """The colour of each pixel and its coverage by the ellipsoid, as the mean over samples.

    `slopes` are the slopes of the rays of all samples, (row, sample, column, sample, 2).
    """
    shape, slopes = slopes.shape[:4], slopes.reshape(-1, 2)
    ways = np.concatenate([slopes, np.ones_like(slopes[:, :1])], -1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.where(ways > 0, (HALF_ROOM - eye) / ways, (-HALF_ROOM - eye) / ways).min(-1)
        table = np.where(ways[:, 1] < 0, (floor - eye[1]) / ways[:, 1], np.inf)
    distance = np.minimum(walls, table)
    points = eye + distance[:, None] * ways
    colour = _texture(points, texture, 1.6, octaves)
    colour = (0.35 * colour + 0.65 * colour.mean(-1, keepdims=True)) * np.where(table < walls, 0.95, 0.75)[:, None]
    covered = np.zeros(len(ways))
    if ball:
        a, b = np.square(ways / AXES).sum(-1), (ways / AXES) @ (eye / AXES)
        root = b * b - a * (np.square(eye / AXES).sum() - 1)
        hit = root > 0
        near = eye + ((-b[hit] - np.sqrt(root[hit])) / a[hit])[:, None] * ways[hit]
        normal = near / AXES**2
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        shade = 0.45 + 0.55 * (normal @ (LIGHT / np.linalg.norm(LIGHT))).clip(0)
        colour[hit] = (0.25 + 0.75 * _texture(near, texture, 4.0, octaves)) * shade[:, None] * [1.0, 0.7, 0.45]
        covered[hit] = 1.0

    def mean(values: Array) -> Array:
        return values.reshape(*shape, -1).mean((1, 3))

    return mean(colour), mean(covered)[..., 0]


def _texture(points: Array, table: Array, frequency: float, octaves: int) -> Array:
    """Colours at points from noise of several octaves, interpolated trilinearly in a periodic table."""
    side = len(table)
    repeated = np.pad(table, ((0, 1), (0, 1), (0, 1), (0, 0)), mode="wrap") - 0.5
    volume = torch.from_numpy(repeated).permute(3, 2, 1, 0)[None]  # (1, 3, z, y, x)
    total = torch.zeros(3, len(points))
    for octave in range(octaves):
        where = np.mod(points * (frequency * 2.1**octave), side).astype(np.float32)
        grid = torch.from_numpy(2 / side * where - 1)[None, None, None]
        total += 0.75**octave * grid_sample(volume, grid, align_corners=True).reshape(3, -1)
    return (0.5 + 0.55 * total).clamp(0, 1).T.numpy()


def _without_lens(slopes: Array, lens: tuple[float, float]) -> Array:
    """Undistorted slopes of rays, from distorted ones."""
    if not any(lens):
        return slopes
    coefficients = torch.tensor([[*lens, 0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    count, limit = len(slopes), turning_radius(coefficients)
    found, _ = inverse_distortion(torch.from_numpy(slopes), coefficients.expand(count, -1), limit.expand(count), 1e-6)
    return found.numpy()


def _lens_source(size: tuple[int, int], calibration: Array, lens: tuple[float, float]) -> Array:
    """For each pixel of the distorted image, its position (row, column) in the pinhole image."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    pixels = np.stack([columns, rows], -1).reshape(-1, 2)
    focal, centre = calibration[[0, 1], [0, 1]], calibration[:2, 2]
    return (_without_lens((pixels - centre) / focal, lens) * focal + centre)[:, ::-1]


def _through_lens(picture: Array, source: Array) -> Array:
    """A pinhole image, distorted by the lens."""
    channels = [ndimage.map_coordinates(channel, source.T, order=1) for channel in np.moveaxis(picture, -1, 0)]
    return np.stack(channels, -1).reshape(picture.shape)
