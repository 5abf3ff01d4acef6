"""Rendering with pyrender on EGL or OSMesa. Imports pyrender only when the first renderer is made."""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from data_gen.rendering.lighting import Lighting
from data_gen.rendering.renderers import RendererError
from data_gen.rendering.surfaces import ShadedSurface
from data_gen.rigs import Rig
from hyperplanes.utilities.axes import flip_camera_axes

__all__ = ["PyrenderRenderer"]


# Deleting any EGL renderer breaks all others of the process, so there is only one, which is never deleted.
_renderer: Any = None
_made_in: tuple[int, int] | None = None


class PyrenderRenderer:
    """Renders with the single pyrender OffscreenRenderer of this process.

    Args:
        platform: `egl` or `osmesa`.

    Raises:
        RendererError: if OpenGL is loaded for another platform, or cannot be used in this thread or process.
    """

    def __init__(self, platform: str) -> None:
        self._renderer = _shared_renderer(platform)
        from OpenGL import GL

        names = (GL.glGetString(GL.GL_RENDERER), GL.glGetString(GL.GL_VERSION))
        self.detail = ", OpenGL ".join((name or b"unknown").decode() for name in names)

    def draw(
        self, surfaces: Sequence[ShadedSurface], rig: Rig, lighting: Lighting, supersample: int
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Render all views, as described in `mesh_renderer.ViewRenderer`."""
        _check_owner()
        renderer = self._renderer
        drawables = renderer.load(surfaces)
        size = (rig.width, rig.height, supersample)
        radius = max(float(np.linalg.norm(surface.positions, axis=1).max()) for surface in surfaces)
        try:
            for pose, intrinsics in zip(rig.world_from_camera, rig.intrinsics, strict=True):
                clip_from_world = _projection(intrinsics, rig, pose, radius) @ np.linalg.inv(flip_camera_axes(pose))
                light_directions = lighting.directions(pose)
                yield renderer.draw(drawables, size, clip_from_world, pose[:3, 3], lighting, light_directions)
        finally:
            renderer.load([])


def _projection(
    intrinsics: npt.NDArray[np.float64], rig: Rig, pose: npt.NDArray[np.float64], radius: float
) -> npt.NDArray[np.float64]:
    """OpenGL's projection: the centre of pixel (0, 0) of the intrinsics is half a pixel inside OpenGL's window."""
    import pyrender

    distance = float(np.linalg.norm(pose[:3, 3]))
    camera = pyrender.IntrinsicsCamera(
        fx=intrinsics[0, 0],
        fy=intrinsics[1, 1],
        cx=intrinsics[0, 2] + 0.5,
        cy=intrinsics[1, 2] + 0.5,
        znear=max(distance - 1.01 * radius, 0.01 * distance),
        zfar=distance + 1.01 * radius,
    )
    return camera.get_projection_matrix(rig.width, rig.height)


def _shared_renderer(platform: str) -> Any:
    global _renderer, _made_in
    if _renderer is None:
        _import_pyrender(platform)
        import pyrender

        from data_gen.rendering.opengl.pyrender_pass import SurfaceRenderer

        # pyrender makes the context; our renderer replaces its own, which has drawn nothing yet.
        context = pyrender.OffscreenRenderer(64, 64)
        context._renderer = SurfaceRenderer(64, 64)
        _renderer, _made_in = context, (os.getpid(), threading.get_ident())
    elif os.environ.get("PYOPENGL_PLATFORM") != platform:
        loaded = os.environ.get("PYOPENGL_PLATFORM")
        raise RendererError(f"renderer: expected pyrender-{loaded}, which this process uses, got pyrender-{platform}")
    _check_owner()
    return _renderer._renderer


def _check_owner() -> None:
    here = (os.getpid(), threading.get_ident())
    if _made_in != here:
        raise RendererError(
            "renderer: expected the process and thread that made the OpenGL context "
            f"{_made_in}, got {here}; start workers with the 'spawn' method and draw in one thread of each"
        )


def _import_pyrender(platform: str) -> None:
    """Import pyrender for a platform; PyOpenGL reads it from the environment once."""
    current = os.environ.get("PYOPENGL_PLATFORM")
    if "OpenGL.platform" in sys.modules and current != platform:
        raise RendererError(
            f"PYOPENGL_PLATFORM: expected {platform!r} when this process first imported OpenGL, found {current!r}; "
            f"set PYOPENGL_PLATFORM={platform} before Python starts, or make the MeshRenderer before importing pyrender"
        )
    os.environ["PYOPENGL_PLATFORM"] = platform
    with warnings.catch_warnings():
        # Import warnings of old releases of these packages do not concern users.
        warnings.simplefilter("ignore")
        import pyglet

        pyglet.options["headless"] = True  # otherwise pyglet, imported by pyrender's window, needs X11
        import pyrender  # noqa: F401
