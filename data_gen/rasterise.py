"""Meshes and cameras in, pictures out: the one way to draw in data_gen.

Pictures are RGBA with straight (not premultiplied) alpha: ``rgb * a + white * (1 - a)`` composites over white without
dark fringes. They are drawn over black at a multiple of the resolution, averaged while premultiplied, and divided by
their alpha at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen.backends import Backend, find_backend
from data_gen.lighting import Lighting, resolve_lighting
from data_gen.rigs import Rig
from data_gen.surfaces import RasteriseError, surfaces_of

__all__ = ["CHANNELS", "Part", "RasteriseError", "Rasteriser", "Rendering"]

Part = tuple[trimesh.Trimesh, npt.ArrayLike, bool]
"""A mesh, its pose world_from_mesh (4, 4), and whether it is shaded smoothly."""

CHANNELS = ("rgba",)
"""What render can return."""


@dataclass(frozen=True)
class Rendering:
    """Pictures of one object.

    Attributes:
        rgba: Colours uint8 ``(view, height, width, 4)``, sRGB, straight alpha.
        depth: Distance along the camera's z axis float32 ``(view, height, width)``, world units, or None.
        normals: Unit normals towards the camera float32 ``(view, height, width, 3)``, world axes, or None.
        coordinates: Surface points float32 ``(view, height, width, 3)``, world units, or None.
        mask: Whether the pixel's centre sees the object, bool ``(view, height, width)``, or None.
    """

    rgba: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32] | None = None
    normals: npt.NDArray[np.float32] | None = None
    coordinates: npt.NDArray[np.float32] | None = None
    mask: npt.NDArray[np.bool_] | None = None


class Rasteriser:
    """Draws meshes with the renderer that works here. A context manager.

    Args:
        backend: A Backend, the name of one, or None for the best that works here.
        supersample: Samples along a side of a pixel.
    """

    def __init__(self, backend: Backend | str | None = None, supersample: int = 3) -> None:
        self.name = backend if isinstance(backend, str) else (backend or find_backend()).name
        self.supersample = supersample
        self._engine: Any = _make_engine(self.name)
        self.detail: str = self._engine.detail

    def __enter__(self) -> Rasteriser:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go of the renderer."""
        self.close()

    def close(self) -> None:
        """Let go of the renderer."""
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
            The pictures.

        Raises:
            RasteriseError: If nothing of the object is visible in any view.
        """
        surfaces = surfaces_of(parts, name)
        pictures = self._engine.draw(surfaces, rig, resolve_lighting(lighting, seed=seed), self.supersample)
        rgba = np.stack([_straight(picture) for picture in pictures])
        if not rgba[..., 3].any():
            raise RasteriseError(
                f"{name}: expected some of it to be visible in {len(rig)} views, found every one blank"
            )
        return Rendering(rgba)


def _make_engine(name: str) -> Any:
    from data_gen.pyrender_backend import PyrenderBackend

    return PyrenderBackend(name.removeprefix("pyrender-"))


def _straight(picture: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Straight uint8 of premultiplied RGBA, both from 0 to 255."""
    alpha = picture[..., 3:]
    colour = np.divide(picture[..., :3] * 255.0, alpha, out=np.zeros_like(picture[..., :3]), where=alpha > 0)
    return np.clip(np.rint(np.concatenate((colour, alpha), axis=-1)), 0, 255).astype(np.uint8)
