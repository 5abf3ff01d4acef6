"""How much light arrives inside a grid of voxels, compiled for the CPU where numba is there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.kernels.compiling import compile_function
from hyperplanes.geometry.kernels.threads import parallel_for

__all__ = ["compiled_light", "light_arriving"]

CELLS = 1 << 12  # that are looked at together
DARK = 12.0  # thickness behind which nothing is left of single precision


def compiled_light() -> Callable[..., None] | None:
    """The compiled walk through the voxels, or None where numba is missing."""
    return compile_function(_walk)


def light_arriving(
    thickness: Float[Tensor, "x y z"], cells: Int[Tensor, "cell 3"], directions: Float[Tensor, "direction 3"]
) -> Float[Tensor, "cell direction"]:
    """The part of the light from outside that arrives at voxels, having come along each direction.

    It is followed backwards from the voxel's centre in steps of one voxel, the first of which leaves the voxel itself
    behind, and sees each voxel it stands in as a whole.

    Args:
        thickness: density of each voxel times its side.
        cells: of which voxels, as indices (x, y, z).
        directions: unit vectors in which the light travels.

    Returns:
        Transmittances in [0, 1].
    """
    found = torch.empty(len(cells), len(directions), device=thickness.device)
    walk = compiled_light()
    if walk is not None and thickness.device.type == "cpu":
        arrays = (thickness.contiguous().numpy(), cells.contiguous().numpy(), directions.contiguous().numpy())
        parallel_for(lambda start, stop: walk(*arrays, found.numpy(), start, stop), len(cells), CELLS)
        return found
    side, flat = thickness.shape[0], thickness.flatten()
    for start in range(0, len(cells), CELLS):
        hidden = torch.zeros_like(found[start : start + CELLS])
        centres = cells[start : start + CELLS, None].float() + 0.5
        for step in range(math.ceil(math.sqrt(3) * side)):
            here = (centres - (step + 1) * directions).floor().long()
            inside = ((here >= 0) & (here < side)).all(-1)
            here = here.clamp(0, side - 1)
            hidden += flat[(here[..., 0] * side + here[..., 1]) * side + here[..., 2]] * inside
        found[start : start + CELLS] = torch.exp(-hidden)
    return found


@no_type_check
def _walk(thickness, cells, directions, found, start, stop):
    """The light that arrives at cells start..stop."""
    side = thickness.shape[0]
    for cell in range(start, stop):
        for direction in range(directions.shape[0]):
            x, y, z = directions[direction, 0], directions[direction, 1], directions[direction, 2]
            hidden, step = 0.0, 1.0
            while hidden < DARK:
                at_x = int(math.floor(cells[cell, 0] + 0.5 - step * x))
                at_y = int(math.floor(cells[cell, 1] + 0.5 - step * y))
                at_z = int(math.floor(cells[cell, 2] + 0.5 - step * z))
                if min(at_x, at_y, at_z) < 0 or max(at_x, at_y, at_z) >= side:
                    break
                hidden += thickness[at_x, at_y, at_z]
                step += 1.0
            found[cell, direction] = math.exp(-hidden)
