"""Volume rendering of any field given as a callable (points, directions) -> (colour, density)."""

from hyperplanes.rendering.compositing import Rendered, composite, composite_packed, packed_weights
from hyperplanes.rendering.marching import Packed, march
from hyperplanes.rendering.renderer import FieldFunction, Hierarchical, Marched, render, render_in_chunks
from hyperplanes.rendering.sampling import importance, intervals, stratified

__all__ = [
    "FieldFunction",
    "Hierarchical",
    "Marched",
    "Packed",
    "Rendered",
    "composite",
    "composite_packed",
    "importance",
    "intervals",
    "march",
    "packed_weights",
    "render",
    "render_in_chunks",
    "stratified",
]
