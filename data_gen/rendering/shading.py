"""The shading formula in NumPy, for arrays of points: the same as in the OpenGL shader.

Light is summed in linear units: ambient light that changes from sky to ground with the normal's height, and for each
light a Lambertian term and a GGX highlight (Walter et al. 2007, with Smith's shadowing in Schlick's form). Normals are
flipped towards the camera, so that sheets are lit on both sides and the winding of faces does not matter. Values above
SHOULDER are compressed below white (tone mapping), and the result is encoded as sRGB.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from data_gen.rendering.lighting import Lighting
from hyperplanes.utilities.images.colour import srgb_from_linear

__all__ = ["SHOULDER", "facing", "shade"]

Floats = npt.NDArray[np.float64]

SHOULDER = 0.8
"""Reflected light above this is compressed towards 1."""


def facing(normals: Floats, facets: Floats, view_directions: Floats) -> Floats:
    """Unit normals on the side of the surface that the camera sees.

    Args:
        normals: interpolated vertex normals `(point, 3)`, of any length; zero means the facet's.
        facets: normals of the faces `(point, 3)`, of any length and sign.
        view_directions: directions to the camera `(point, 3)`.

    Returns:
        Unit normals `(point, 3)`.
    """
    facets = np.where(_dot(facets, view_directions) < 0.0, -facets, facets)
    normals = np.where(_dot(normals, normals) > 1e-8, normals, facets)
    normals = np.where(_dot(normals, facets) < 0.0, -normals, normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)


def shade(
    base: Floats,
    emission: Floats,
    normals: Floats,
    view_directions: Floats,
    roughness: Floats,
    metallic: Floats,
    lighting: Lighting,
    directions: Floats,
) -> Floats:
    """Shaded colours.

    Args:
        base: linear base colours `(point, 3)`.
        emission: linear emitted light `(point, 3)`.
        normals: unit normals towards the camera `(point, 3)`.
        view_directions: unit directions to the camera `(point, 3)`.
        roughness: roughness `(point, 1)`.
        metallic: metalness `(point, 1)`.
        lighting: the lights.
        directions: unit vectors to the lights `(light, 3)` in world axes.

    Returns:
        sRGB colours `(point, 3)` in [0, 1].
    """
    nv = np.maximum(_dot(normals, view_directions), 0.05)
    diffuse = base * (1.0 - 0.5 * metallic)
    f0 = 0.04 + metallic * (base - 0.04)
    a2 = roughness**4
    k = (roughness + 1.0) ** 2 / 8.0
    height = 0.5 + 0.5 * normals[:, 1:2]
    light = diffuse * (np.array(lighting.ground) * (1.0 - height) + np.array(lighting.sky) * height)
    for direction, colour in zip(directions, lighting.colours, strict=True):
        nl = np.maximum(_dot(normals, direction), 0.0)
        half = direction + view_directions
        half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-30)
        d = np.maximum(_dot(normals, half), 0.0) ** 2 * (a2 - 1.0) + 1.0
        fresnel = f0 + (1.0 - f0) * (1.0 - np.maximum(_dot(view_directions, half), 0.0)) ** 5
        highlight = a2 / (4.0 * d * d * (nl * (1.0 - k) + k) * (nv * (1.0 - k) + k))
        light += nl * colour * (diffuse + fresnel * highlight)
    rolled = SHOULDER + (1.0 - SHOULDER) * (1.0 - np.exp((SHOULDER - np.maximum(light, SHOULDER)) / (1.0 - SHOULDER)))
    light = np.where(light > SHOULDER, rolled, light)
    return srgb_from_linear(np.clip(light + emission, 0.0, 1.0))


def _dot(one: Floats, other: Floats) -> Floats:
    if other.ndim == 1:
        return one @ other[:, None]
    return np.einsum("...i,...i->...", one, other)[..., None]
