"""Renders meshes from the cameras of a rig into RGBA, depth, normals and coordinates.

Pictures are RGBA with straight (not premultiplied) alpha: `rgb * a + white * (1 - a)` composites over white without
dark fringes. They are drawn over black at a multiple of the resolution, averaged while premultiplied, and divided by
their alpha at the end. Depth, normals and coordinates are not averaged: they are those of the pixel's centre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen import SUPERSAMPLE
from data_gen.rendering.lighting import Lighting, resolve_lighting
from data_gen.rendering.renderers import REMEDIES, RENDERERS, RendererError, find_renderer
from data_gen.rendering.surfaces import RenderError, ShadedSurface, shaded_surfaces
from data_gen.rigs import Rig

__all__ = ["MAX_SUPERSAMPLE", "RENDER_CHANNELS", "MeshRenderer", "RenderError", "Rendering", "ViewRenderer"]

RENDER_CHANNELS = ("rgba", "depth", "normals", "coordinates")
"""What `render` can return."""

MAX_SUPERSAMPLE = 8
"""Most samples along a side of a pixel."""


@dataclass(frozen=True)
class Rendering:
    """Pictures of one object. Channels that were not requested are None; empty pixels are 0 in every channel.

    Geometry is that of the first surface at the pixel's centre that is at least half opaque.

    Attributes:
        rgba: colours uint8 `(view, height, width, 4)`, sRGB, straight alpha.
        depth: distance along the camera's z axis float32 `(view, height, width)`, world units.
        normals: shading normals towards the camera float32 `(view, height, width, 3)`, unit vectors in world axes:
            interpolated on smooth surfaces, the face's own elsewhere.
        coordinates: points on the surface float32 `(view, height, width, 3)`, world units.
    """

    rgba: npt.NDArray[np.uint8] | None = None
    depth: npt.NDArray[np.float32] | None = None
    normals: npt.NDArray[np.float32] | None = None
    coordinates: npt.NDArray[np.float32] | None = None


class ViewRenderer(Protocol):
    """The interface of `EmbreeRenderer` and `PyrenderRenderer`; `detail` describes the renderer in one line."""

    detail: str

    def draw(
        self, surfaces: Sequence[ShadedSurface], rig: Rig, lighting: Lighting, supersample: int
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Render the surfaces from each camera of the rig, with supersample x supersample samples per pixel.

        Yields:
            sRGB with straight alpha `(height, width, 4)`, one view at a time.
        """
        ...


class MeshRenderer:
    """Renders meshes with the best renderer that works here.

    All MeshRenderers of a process that use pyrender share one renderer, so another one costs nothing; they must all be
    used in the thread that made the first. The process keeps its OpenGL context.

    Args:
        renderer: the name of a renderer, or None for the best that works here.
        supersample: samples along a side of a pixel, 1 to MAX_SUPERSAMPLE: 3 gives alpha ten values, 4 seventeen.

    Raises:
        RendererError: if no renderer works, or the one named does not.
        ValueError: if supersample is out of range or the renderer is unknown.

    Attributes:
        name: name of the renderer, one of `data_gen.rendering.renderers.RENDERERS`.
        detail: description, e.g. the OpenGL renderer and version.
        supersample: samples along a side of a pixel.
    """

    def __init__(self, renderer: str | None = None, supersample: int = SUPERSAMPLE) -> None:
        if not 1 <= supersample <= MAX_SUPERSAMPLE:
            raise ValueError(f"supersample: expected 1 to {MAX_SUPERSAMPLE}, got {supersample}")
        self.name = renderer or find_renderer().name
        self.supersample = supersample
        self._renderer = _make_renderer(self.name)
        self.detail = self._renderer.detail

    def render(
        self,
        parts: Sequence[trimesh.Trimesh],
        rig: Rig,
        *,
        lighting: str | Lighting = "studio",
        channels: Sequence[str] = ("rgba",),
        name: str = "object",
        seed: int = 0,
    ) -> Rendering:
        """Render an object from every camera of a rig.

        Args:
            parts: meshes in world coordinates, as for `shaded_surfaces`.
            rig: the cameras.
            lighting: name of a preset or a Lighting.
            channels: what to return, of RENDER_CHANNELS.
            name: name of the object in errors.
            seed: seed of random lighting.

        Returns:
            The requested channels.

        Raises:
            RenderError: if the parts cannot be drawn, or nothing of them is visible in any view.
            ValueError: if the lighting or a channel is unknown.
        """
        unknown = sorted(set(channels) - set(RENDER_CHANNELS))
        if unknown or not channels:
            raise ValueError(
                f"channels: expected some of {', '.join(RENDER_CHANNELS)}, got {', '.join(channels) or 'none'}"
            )
        lights = resolve_lighting(lighting, seed=seed)
        surfaces = shaded_surfaces(parts, name)
        pictures: dict[str, npt.NDArray] = {}
        if "rgba" in channels:
            pictures["rgba"] = np.stack(list(self._renderer.draw(surfaces, rig, lights, self.supersample)))
            visible = pictures["rgba"][..., 3].any()
        if set(channels) - {"rgba"}:
            from data_gen.rendering.ray_tracing.embree import cast_geometry

            views = list(cast_geometry(surfaces, rig))
            for channel in RENDER_CHANNELS[1:]:
                if channel in channels:
                    pictures[channel] = np.stack([getattr(view, channel) for view in views])
            if "rgba" not in channels:
                visible = any(view.depth.any() for view in views)
        if not visible:
            raise RenderError(f"{name}: expected some of it to be visible in {len(rig)} views, found every one blank")
        return Rendering(**pictures)


def _make_renderer(name: str) -> ViewRenderer:
    if name not in RENDERERS:
        raise ValueError(f"renderer: expected one of {', '.join(RENDERERS)}, got {name!r}")
    try:
        if name == "embree":
            from data_gen.rendering.ray_tracing.embree import EmbreeRenderer

            return EmbreeRenderer()
        from data_gen.rendering.opengl.pyrender_renderer import PyrenderRenderer

        return PyrenderRenderer(name.removeprefix("pyrender-"))
    except RendererError:
        raise
    except Exception as error:  # missing libraries and drivers raise nearly any type
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise RendererError(
            f"renderer {name!r}: expected it to start, found {reason}. Remedy: {REMEDIES[name]}"
        ) from error
