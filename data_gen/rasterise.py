"""Meshes and cameras in, pictures out: the one way to draw in data_gen.

Pictures are RGBA with straight (not premultiplied) alpha: ``rgb * a + white * (1 - a)`` composites over white without
dark fringes. They are drawn over black at a multiple of the resolution, averaged while premultiplied, and divided by
their alpha at the end. Depth, normals, coordinates and mask are not averaged: they are those of the pixel's centre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen import SUPERSAMPLE
from data_gen.backends import BACKENDS, Backend, RendererError, find_backend, remedy
from data_gen.lighting import Lighting, resolve_lighting
from data_gen.rig import Rig
from data_gen.surfaces import RasteriseError, Surface, surfaces_of

__all__ = ["CHANNELS", "MAX_SUPERSAMPLE", "Part", "RasteriseError", "Rasteriser", "Rendering"]

Part = tuple[trimesh.Trimesh, npt.NDArray[np.float64], bool]
"""A mesh, its pose world_from_mesh (4, 4), and whether it is shaded smoothly."""

CHANNELS = ("rgba", "depth", "normals", "coordinates", "mask")
"""What render can return."""

MAX_SUPERSAMPLE = 8
"""Most samples along a side of a pixel."""


@dataclass(frozen=True)
class Rendering:
    """Pictures of one object. Channels that were not asked for are None; empty pixels are 0 in every channel.

    Attributes:
        rgba: Colours uint8 ``(view, height, width, 4)``, sRGB, straight alpha.
        depth: Distance along the camera's z axis float32 ``(view, height, width)``, world units.
        normals: Unit normals towards the camera float32 ``(view, height, width, 3)``, world axes, as they are shaded:
            interpolated on what is smooth, the face's own elsewhere.
        coordinates: Points on the surface float32 ``(view, height, width, 3)``, world units.
        mask: Whether the pixel's centre sees a surface that is at least half opaque, bool ``(view, height, width)``.
    """

    rgba: npt.NDArray[np.uint8] | None = None
    depth: npt.NDArray[np.float32] | None = None
    normals: npt.NDArray[np.float32] | None = None
    coordinates: npt.NDArray[np.float32] | None = None
    mask: npt.NDArray[np.bool_] | None = None


class _Engine(Protocol):
    detail: str

    def draw(
        self, surfaces: Sequence[Surface], rig: Rig, lighting: Lighting, supersample: int
    ) -> Iterator[npt.NDArray[np.uint8]]: ...


class Rasteriser:
    """Draws meshes with the renderer that works here. A context manager.

    All Rasterisers of a process that draw with pyrender share its one renderer, so making another costs nothing; they
    must all be used in the thread that made the first.

    Args:
        backend: A Backend, the name of one, or None for the best that works here.
        supersample: Samples along a side of a pixel, 1 to MAX_SUPERSAMPLE: 3 gives alpha ten values, 4 seventeen.

    Raises:
        RendererError: If no renderer works, or the one asked for does not.
        ValueError: If supersample is out of range or the backend has an unknown name.

    Attributes:
        name: Name of the renderer, one of `data_gen.backends.BACKENDS`.
        detail: What draws, e.g. the OpenGL renderer and version.
        supersample: Samples along a side of a pixel.
    """

    def __init__(self, backend: Backend | str | None = None, supersample: int = SUPERSAMPLE) -> None:
        if not 1 <= supersample <= MAX_SUPERSAMPLE:
            raise ValueError(f"supersample: expected 1 to {MAX_SUPERSAMPLE}, received {supersample}")
        self.name = backend if isinstance(backend, str) else (backend or find_backend()).name
        self.supersample = supersample
        self._engine: _Engine | None = _make_engine(self.name)
        self.detail = self._engine.detail

    def __enter__(self) -> Rasteriser:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Let go of the renderer. The process keeps its OpenGL context for the next Rasteriser."""
        self._engine = None

    def render(
        self,
        parts: Sequence[Part],
        rig: Rig,
        *,
        lighting: str | Lighting = "studio",
        channels: Sequence[str] = ("rgba",),
        name: str = "object",
        seed: int = 0,
    ) -> Rendering:
        """Draw an object from every camera of a rig.

        Args:
            parts: Meshes with their poses and whether they are smooth.
            rig: The cameras.
            lighting: Name of a preset or a Lighting.
            channels: What to return, of CHANNELS.
            name: What to call the object in errors.
            seed: Seed of random lighting.

        Returns:
            The channels asked for.

        Raises:
            RasteriseError: If the parts cannot be drawn, or nothing of them is visible in any view.
            ValueError: If the Rasteriser is closed, or lighting or a channel has an unknown name.
        """
        if self._engine is None:
            raise ValueError("rasteriser: expected an open one, received one that was closed")
        unknown = sorted(set(channels) - set(CHANNELS))
        if unknown or not channels:
            raise ValueError(
                f"channels: expected some of {', '.join(CHANNELS)}, received {', '.join(channels) or 'none'}"
            )
        lights = resolve_lighting(lighting, seed=seed)
        surfaces = surfaces_of(parts, name)
        pictures: dict[str, npt.NDArray] = {}
        if "rgba" in channels:
            pictures["rgba"] = np.stack(list(self._engine.draw(surfaces, rig, lights, self.supersample)))
            visible = pictures["rgba"][..., 3].any()
        if set(channels) - {"rgba"}:
            from data_gen.embree_backend import cast_geometry

            views = list(cast_geometry(surfaces, rig))
            for channel in CHANNELS[1:]:
                if channel in channels:
                    pictures[channel] = np.stack([getattr(view, channel) for view in views])
            if "rgba" not in channels:
                visible = any(view.mask.any() for view in views)
        if not visible:
            raise RasteriseError(
                f"{name}: expected some of it to be visible in {len(rig)} views, found every one blank"
            )
        return Rendering(**pictures)


def _make_engine(name: str) -> _Engine:
    if name not in BACKENDS:
        raise ValueError(f"renderer: expected one of {', '.join(BACKENDS)}, received {name!r}")
    try:
        if name == "embree":
            from data_gen.embree_backend import EmbreeBackend

            return EmbreeBackend()
        from data_gen.pyrender_backend import PyrenderBackend

        return PyrenderBackend(name.removeprefix("pyrender-"))
    except RendererError:
        raise
    except Exception as error:  # missing libraries and drivers show as nearly any type
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise RendererError(
            f"renderer {name!r}: expected it to start, found {reason}. Remedy: {remedy(name)}"
        ) from error
