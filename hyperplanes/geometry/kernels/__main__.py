"""Compile the kernels that fields are rendered with, so that the first picture need not: `scripts/setup` does it."""

from __future__ import annotations

import torch

from hyperplanes.geometry.kernels.compiling import compile_kernel, layers_module

__all__ = ["RENDERING"]

RENDERING = {
    "described.describe": "",
    "lookup_forward.forward": "projected",
    "visibility.choose": "",
    "carving.carve": "",
    "hull_hits.hull_hits": "",
    "marching.march": "",
    "first_hits.first_hits": "",
}
"""Names of kernels, and what they take as points."""

if __name__ == "__main__":
    for name, points in RENDERING.items():
        compile_kernel(name, torch.float32, points)
    if module := layers_module():
        compile_kernel(f"{module}.layers", torch.float32)
