"""Compile the kernels that fields are rendered with, so that the first picture need not: `scripts/setup` does it."""

from __future__ import annotations

import torch

from hyperplanes.geometry.kernels.compiling import compile_kernel, layers_module

__all__ = ["RENDERING", "rendering_kernels"]

RENDERING = {
    "described.describe": "",
    "lookup_forward.forward": "projected",
    "visibility.choose": "",
    "carving.carve": "",
    "hull_hits.hull_hits": "",
    "hull_centres.centres": "",
    "marching.march": "",
    "first_hits.first_hits": "",
    "footprints.footprints": "",
}
"""Names of kernels, and what they take as points; those of layers are the processor's."""


def rendering_kernels() -> dict[str, str]:
    """As RENDERING, with the kernels of layers that are used on this processor."""
    modules = {layers_module(), layers_module(mixed_precision=True)} - {None}
    return {**RENDERING, **{f"{module}.layers": "" for module in modules}}


if __name__ == "__main__":
    for name, points in rendering_kernels().items():
        compile_kernel(name, torch.float32, points)
