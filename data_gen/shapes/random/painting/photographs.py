"""Crops of photographs as textures: those in scikit-image that are free of rights.

According to scikit-image's documentation (`skimage.data`), which names all sources, brick, grass, gravel, camera,
chelsea, coffee and cell are CC0, and rocket and clock are in the public domain. They are read from the installed
package.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from data_gen.shapes import patterns
from data_gen.shapes.choices import one_of
from data_gen.shapes.materials import Material
from data_gen.shapes.random.painting.colours import random_colour

__all__ = ["PHOTOGRAPHS", "photograph"]

PHOTOGRAPHS = {
    "brick": "brick.png",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "camera": "camera.png",
    "chelsea": "chelsea.png",
    "coffee": "coffee.png",
    "cell": "cell.png",
    "rocket": "rocket.jpg",
    "clock": "clock_motion.png",
}
"""Names of functions of `skimage.data` and their files."""


@cache
def _pixels(name: str) -> np.ndarray:
    """A photograph (h, w, 3), uint8."""
    found = find_spec("skimage")
    if found is None or found.origin is None:
        raise ValueError("scikit-image: expected an installed package with its pictures; `pip install scikit-image`")
    path = Path(found.origin).parent / "data" / PHOTOGRAPHS[name]
    if not path.is_file():
        raise ValueError(f"{path.name}: expected in scikit-image's folder data, found none; `pip install scikit-image`")
    with Image.open(path, formats=("PNG", "JPEG")) as image:
        return np.asarray(image.convert("RGB"))


def photograph(rng: np.random.Generator) -> Material:
    """A square piece of a photograph, of any size and any of eight orientations; some in two other colours."""
    name = one_of(rng, list(PHOTOGRAPHS))
    pixels = _pixels(name)
    side = int(rng.uniform(0.25, 1.0) * min(pixels.shape[:2]))
    top, left = (int(rng.integers(extent - side + 1)) for extent in pixels.shape[:2])
    piece = np.rot90(pixels[top : top + side, left : left + side], int(rng.integers(4)))
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    size = (patterns.TEXTURE_SIZE, patterns.TEXTURE_SIZE)
    image = np.asarray(Image.fromarray(np.ascontiguousarray(piece)).resize(size, Image.Resampling.BOX))
    grey = bool((pixels[..., 0] == pixels[..., 1]).all())
    if rng.random() < (0.8 if grey else 0.25):
        level = image.mean(axis=-1, keepdims=True) / 255
        dark, light = np.array(random_colour(rng)), np.array(random_colour(rng))
        if dark.sum() > light.sum():
            dark, light = light, dark
        image = np.round((1 - level) * (0.6 * dark) + level * light).astype(np.uint8)
    return Material(name, image)
