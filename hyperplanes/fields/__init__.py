"""Target networks: (x, d; parameters) -> (colour, density)."""

from hyperplanes.fields.base import Field, Target, TargetConfig
from hyperplanes.fields.multiplane import MultiPlaneNeRF, PointMultiPlaneNeRF
from hyperplanes.fields.nerf import NeRF

__all__ = ["TARGETS", "Field", "MultiPlaneNeRF", "NeRF", "PointMultiPlaneNeRF", "Target", "TargetConfig"]

TARGETS: dict[str, type[Target]] = {
    "nerf": NeRF,
    "multiplane": MultiPlaneNeRF,
    "point_multiplane": PointMultiPlaneNeRF,
}
