"""Trilinear texture sampling in NumPy as in OpenGL: mipmaps, bilinear per level, repeated, clamped or mirrored.

trimesh's `uv_to_interpolated_color` has no mipmaps: it skips texels of textures that are small in the picture.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image

from data_gen.meshes.materials import Wrap

__all__ = ["MipmappedTexture"]

Singles = npt.NDArray[np.float32]


class MipmappedTexture:
    """A texture with its mipmaps.

    Args:
        texels: uint8 `(height, width, 4)`, first row on top.
        wrap: wrap mode along u and along v.
    """

    def __init__(self, texels: npt.NDArray[np.uint8], wrap: tuple[Wrap, Wrap]) -> None:
        self._wrap = wrap
        levels = [texels]
        while max(levels[-1].shape[:2]) > 1:
            height, width = levels[-1].shape[:2]
            size = (max(1, width // 2), max(1, height // 2))
            levels.append(np.asarray(Image.fromarray(levels[-1]).resize(size, Image.Resampling.BOX)))
        self.height, self.width = texels.shape[:2]
        self._texels = np.concatenate([level.reshape(-1, 4) for level in levels]).astype(np.float32) / np.float32(255)
        self._sizes = np.array([level.shape[:2] for level in levels], dtype=np.int64)
        self._starts = np.concatenate(([0], np.cumsum(self._sizes.prod(axis=1))[:-1]))

    def sample(self, uv: npt.NDArray[np.float64], level: npt.NDArray[np.float64]) -> Singles:
        """Sample the texture.

        Args:
            uv: coordinates `(point, 2)`, v upwards.
            level: binary logarithm `(point,)` of the texels between neighbouring samples; full size at 0 and below.

        Returns:
            RGBA `(point, 4)` in [0, 1], encoded as in the texture.
        """
        level = np.clip(level, 0.0, len(self._sizes) - 1.0)
        low = np.floor(level).astype(np.int64)
        colours = self._bilinear(uv, low)
        between = (level - low).astype(np.float32)
        mixed = np.flatnonzero(between > 0.0)
        if len(mixed):
            weight = between[mixed, None]
            colours[mixed] += weight * (self._bilinear(uv[mixed], low[mixed] + 1) - colours[mixed])
        return colours

    def _bilinear(self, uv: npt.NDArray[np.float64], level: npt.NDArray[np.int64]) -> Singles:
        height, width = self._sizes[level, 0], self._sizes[level, 1]
        x = _into(uv[:, 0], self._wrap[0]) * width - 0.5
        y = (1.0 - _into(uv[:, 1], self._wrap[1])) * height - 0.5
        left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        across, down = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]

        def texel(row: npt.NDArray[np.int64], column: npt.NDArray[np.int64]) -> Singles:
            column = column % width if self._wrap[0] == "repeat" else np.clip(column, 0, width - 1)
            row = row % height if self._wrap[1] == "repeat" else np.clip(row, 0, height - 1)
            return self._texels[self._starts[level] + row * width + column]

        upper = texel(top, left) * (1 - across) + texel(top, left + 1) * across
        lower = texel(top + 1, left) * (1 - across) + texel(top + 1, left + 1) * across
        return (upper * (1 - down) + lower * down).astype(np.float32, copy=False)


def _into(coordinates: npt.NDArray[np.float64], wrap: Wrap) -> npt.NDArray[np.float64]:
    """Coordinates wrapped into [0, 1]."""
    if wrap == "clamp":
        return np.clip(coordinates, 0.0, 1.0)
    if wrap == "mirror":
        return 1.0 - np.abs(coordinates % 2.0 - 1.0)
    return coordinates % 1.0
