"""Compile the rendering kernels before the first picture needs them; `scripts/setup` runs this."""

from __future__ import annotations

import torch

from hyperplanes.geometry.kernels.compiling import compile_kernel, layers_module

__all__ = ["RENDERING", "rendering_kernels"]

RENDERING = {
    "visibility.describing.describe": "",
    "lookup.forward.forward": "projected",
    "visibility.choosing.choose": "",
    "hull.carving.carve": "",
    "hull.hull_hits.hull_hits": "",
    "hull.centres.centres": "",
    "voxels.marching.march": "",
    "hull.first_hits.first_hits": "",
    "hull.footprints.footprints": "",
}
"""Names of kernels, and what they take as points; kernels of layers depend on the processor."""


def rendering_kernels() -> dict[str, str]:
    """RENDERING and the kernels of layers that this processor uses."""
    modules = {layers_module(), layers_module(mixed_precision=True)} - {None}
    return {**RENDERING, **{f"{module}.layers": "" for module in modules}}


if __name__ == "__main__":
    for name, points in rendering_kernels().items():
        compile_kernel(name, torch.float32, points)
