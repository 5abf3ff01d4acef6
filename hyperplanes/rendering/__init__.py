"""Volume rendering of any callable (points, directions) -> (colour, density)."""

from hyperplanes.rendering.compositing import Rendered, composite, composite_packed, packed_weights
from hyperplanes.rendering.images import Pictures
from hyperplanes.rendering.renderer import render
from hyperplanes.rendering.sampling.hierarchical import Hierarchical, importance, intervals, stratified
from hyperplanes.rendering.sampling.marching import RayMarching, march
from hyperplanes.rendering.sampling.samplers import DenseSamples, PackedSamples, Sampler
from hyperplanes.rendering.scene import FieldFunction

__all__ = [
    "DenseSamples",
    "FieldFunction",
    "Hierarchical",
    "RayMarching",
    "PackedSamples",
    "Pictures",
    "Rendered",
    "Sampler",
    "composite",
    "composite_packed",
    "importance",
    "intervals",
    "march",
    "packed_weights",
    "render",
    "stratified",
]
