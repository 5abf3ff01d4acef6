"""Differentiable geometry on Kornia's pinhole cameras: projection, lookup, rays, the visual hull."""

from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.lookup import Lookup, sample
from hyperplanes.geometry.occupancy import Occupancy, carve
from hyperplanes.geometry.rays import Rays, Sphere, cast
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry, reflected_cameras

__all__ = [
    "ImagePlanes",
    "Lookup",
    "Occupancy",
    "Plane",
    "Rays",
    "Sphere",
    "Symmetry",
    "carve",
    "cast",
    "reflected_cameras",
    "sample",
]
