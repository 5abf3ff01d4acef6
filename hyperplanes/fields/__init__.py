"""Target networks: (x, d; parameters) -> (colour, density).

Another package adds one with an entry point of the group `hyperplanes.fields` that names a subclass of `Target`.
"""

from hyperplanes.fields.base import Field, Target, TargetConfig
from hyperplanes.fields.image_based import ImageBasedConfig, ImageBasedNeRF
from hyperplanes.fields.multiplane import MultiPlaneNeRF, PointMultiPlaneNeRF
from hyperplanes.fields.nerf import NeRF
from hyperplanes.fields.simplified import SimplifiedNeRF
from hyperplanes.utilities.entry_points import load_entries

__all__ = [
    "TARGETS",
    "ImageBasedConfig",
    "ImageBasedNeRF",
    "Field",
    "MultiPlaneNeRF",
    "NeRF",
    "PointMultiPlaneNeRF",
    "SimplifiedNeRF",
    "Target",
    "TargetConfig",
    "find_targets",
]

TARGETS: dict[str, type[Target]] = {
    "nerf": NeRF,
    "multiplane": MultiPlaneNeRF,
    "point_multiplane": PointMultiPlaneNeRF,
    "image_based": ImageBasedNeRF,
    "simplified_nerf": SimplifiedNeRF,
}


def find_targets() -> dict[str, type[Target]]:
    """All fields by name: those of this package, then those of other installed packages."""
    return TARGETS | load_entries("hyperplanes.fields", TARGETS)
