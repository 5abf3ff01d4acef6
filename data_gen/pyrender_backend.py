"""Drawing with pyrender on EGL or OSMesa. Imports pyrender when the first renderer is made, never before."""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen.backends import RendererError
from data_gen.lighting import Lighting
from data_gen.rigs import Rig

__all__ = ["PyrenderBackend"]

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class PyrenderBackend:
    """Draws with one pyrender OffscreenRenderer, the only one of its process.

    Args:
        platform: ``egl`` or ``osmesa``.
    """

    def __init__(self, platform: str) -> None:
        self.name = f"pyrender-{platform}"
        self._pyrender = _import_pyrender(platform)
        self._renderer = _shared_renderer(self._pyrender)
        from OpenGL import GL

        self.detail = f"{GL.glGetString(GL.GL_RENDERER).decode()}, OpenGL {GL.glGetString(GL.GL_VERSION).decode()}"

    def draw(
        self, parts: Sequence[tuple[trimesh.Trimesh, Any, bool]], rig: Rig, lighting: Lighting, supersample: int
    ) -> npt.NDArray[np.uint8]:
        """Draw all views.

        Args:
            parts: Meshes, their poses ``world_from_mesh`` ``(4, 4)`` and whether to shade them smoothly.
            rig: The cameras.
            lighting: The lights.
            supersample: Samples along a side of a pixel.

        Returns:
            Premultiplied RGBA ``(view, height x supersample, width x supersample, 4)``.
        """
        pyrender = self._pyrender
        scene = pyrender.Scene(bg_color=np.zeros(4), ambient_light=np.array(lighting.sky))
        for mesh, pose, smooth in parts:
            scene.add(pyrender.Mesh.from_trimesh(mesh, smooth=smooth), pose=np.asarray(pose, dtype=np.float64))
        lights = []
        for light in lighting.lights:
            lamp = pyrender.DirectionalLight(color=np.ones(3), intensity=float(np.pi * light.colour[1]))
            lights.append(scene.add(lamp))
        camera = pyrender.IntrinsicsCamera(1.0, 1.0, 0.0, 0.0, znear=0.5 * rig.near, zfar=2.0 * rig.far)
        camera_node = scene.add(camera)
        self._renderer.viewport_width = rig.width * supersample
        self._renderer.viewport_height = rig.height * supersample
        flags = pyrender.RenderFlags.RGBA | pyrender.RenderFlags.SKIP_CULL_FACES
        pictures = np.empty((len(rig), rig.height * supersample, rig.width * supersample, 4), np.uint8)
        for view, (pose, matrix) in enumerate(zip(rig.world_from_camera, rig.intrinsics, strict=True)):
            camera.fx, camera.fy = matrix[0, 0] * supersample, matrix[1, 1] * supersample
            camera.cx, camera.cy = (matrix[0, 2] + 0.5) * supersample, (matrix[1, 2] + 0.5) * supersample
            scene.set_pose(camera_node, pose @ _OPENGL_FROM_OPENCV)
            for node, direction in zip(lights, lighting.directions(pose), strict=True):
                scene.set_pose(node, _pose_along(direction))
            pictures[view] = self._renderer.render(scene, flags)[0]
        return pictures


_renderer: Any = None


def _shared_renderer(pyrender: Any) -> Any:
    global _renderer
    if _renderer is None:
        _renderer = (pyrender.OffscreenRenderer(64, 64), os.getpid(), threading.get_ident())
    return _renderer[0]


def _import_pyrender(platform: str) -> Any:
    loaded = sys.modules.get("OpenGL.platform")
    current = os.environ.get("PYOPENGL_PLATFORM")
    if loaded is not None and current != platform:
        raise RendererError(f"PYOPENGL_PLATFORM: expected {platform!r}, but OpenGL is already loaded with {current!r}")
    os.environ["PYOPENGL_PLATFORM"] = platform
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pyglet

        pyglet.options["headless"] = True
        import pyrender
    return pyrender


def _pose_along(direction: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A pose whose +z axis is the direction towards the light."""
    other = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(other, direction)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, np.cross(direction, x), direction
    return pose
