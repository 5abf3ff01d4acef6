"""Small scenes on disk that are written by hand, without the renderer or the generator."""

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from hyperplanes.geometry import cameras as camera


class Scene:
    """Pictures of a red ball of radius 0.5 at (0.1, 0.2, 0) from all sides, drawn by ray-sphere intersection."""

    centre = np.array([0.1, 0.2, 0.0])
    radius = 0.5
    angle = 0.8

    def __init__(self, views=8, size=(24, 32)):
        self.size = size
        self.names = [f"images/{index:03d}.png" for index in range(views)]
        self.camera_from_world = camera.fibonacci_sphere(views, 3.0, lowest=-0.8).double().numpy()
        focal = size[1] / 2 / math.tan(self.angle / 2)
        self.matrix = np.array([[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]])
        self.pictures = [self.draw(pose) for pose in self.camera_from_world]

    def draw(self, pose):
        rows, columns = np.mgrid[: self.size[0], : self.size[1]]
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(self.matrix).T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        eye = -pose[:3, :3].T @ pose[:3, 3]
        rays = rays @ pose[:3, :3]
        middle = rays @ (self.centre - eye)
        hit = middle**2 - ((self.centre - eye) ** 2).sum() + self.radius**2 > 0
        shade = (np.abs(rays).max(-1) * 200).astype(np.uint8)
        return np.where(
            hit[..., None], np.stack([shade, shade // 4, rows * 5, np.full_like(shade, 255)], -1), 0
        ).astype(np.uint8)

    def opengl(self, index):
        return (np.linalg.inv(self.camera_from_world[index]) * [1, -1, -1, 1]).tolist()

    def document(self, **more):
        frames = [{"file_path": name, "transform_matrix": self.opengl(index)} for index, name in enumerate(self.names)]
        return {"camera_angle_x": self.angle, "frames": frames, **more}

    def write(self, folder, document=None, mode="RGBA"):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        for name, picture in zip(self.names, self.pictures, strict=True):
            Image.fromarray(picture).convert(mode).save(folder / name)
        (folder / "transforms.json").write_text(json.dumps(document or self.document()))
        return folder

    def over_white(self):
        pixels = torch.from_numpy(np.stack(self.pictures)).permute(0, 3, 1, 2).float() / 255
        return pixels[:, :3] * pixels[:, 3:] + 1 - pixels[:, 3:]


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    """One thread reads such small scenes faster than several, on a busy machine ten times."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def scene():
    return Scene()
