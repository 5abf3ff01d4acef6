"""A field as a sparse voxel grid: density and spherical harmonics of colour, interpolated between voxel centres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.files.checkpoints import CheckpointError, load_tensors, save_tensors

__all__ = ["FIRST_HARMONIC", "HARMONICS", "LARGEST_SIDE", "BakedField", "spherical_harmonics"]

HARMONICS = 9
FIRST_HARMONIC = 0.28209479  # of degree 0
LARGEST_SIDE = 512
STORED = {  # dtypes of the tensors in a file
    "occupied": torch.uint8,
    "scaled_density": torch.float16,  # times the radius, so that the range does not depend on the world unit
    "coefficients": torch.uint8,
    "range": torch.float32,
    "sphere": torch.float32,
}


def spherical_harmonics(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """The real spherical harmonics up to degree 2 at unit directions, orthonormal over the sphere.

    >>> round(float(spherical_harmonics(torch.tensor([0.0, 0.0, 1.0]))[0] ** 2 * 4 * torch.pi), 3)
    1.0
    """
    x, y, z = directions.unbind(-1)
    return torch.stack(
        [
            torch.full_like(x, FIRST_HARMONIC),
            -0.48860251 * y,
            0.48860251 * z,
            -0.48860251 * x,
            1.09254843 * x * y,
            -1.09254843 * y * z,
            0.31539157 * (3 * z * z - 1),
            -1.09254843 * x * z,
            0.54627422 * (x * x - y * y),
        ],
        -1,
    )


@dataclass(frozen=True)
class BakedField:
    """A sparse voxel grid: one row of numbers at the centre of every visible voxel.

    Attributes:
        index: row of each voxel of the cube around the bounds, or -1; indexed [x, y, z].
        values: density per world unit, then 3 x 9 coefficients of colour, red first.
        bounds: the sphere of the scene.
    """

    index: Int[Tensor, "x y z"]
    values: Float[Tensor, "row 28"]
    bounds: Sphere

    @property
    def side(self) -> int:
        """Voxels an axis."""
        return self.index.shape[0]

    @property
    def occupancy(self) -> Occupancy:
        """Where interpolation reads a row: the voxels that have one and their neighbours."""
        return Occupancy(self.index >= 0, self.bounds).dilated()

    def centres(self) -> Float[Tensor, "row 3"]:
        """World positions of the centres of the voxels, in the order of their rows."""
        filled = Occupancy(self.index >= 0, self.bounds)
        return torch.empty_like(self.values[:, :3]).index_copy_(0, self.index[filled.occupied].long(), filled.centres())

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour and density, interpolated trilinearly between voxel centres; voxels without a row have density 0.

        Colours are weighted by density, so that they do not fade towards empty voxels.
        """
        side = self.side
        # the eight voxels around each point, and their weights
        place = (self.bounds.normalise(points) + 1) * (side / 2) - 0.5
        low = place.floor()
        fraction = place - low
        low = low.long()
        density = points.new_zeros(len(points))
        coefficients = points.new_zeros(len(points), 3 * HARMONICS)
        padded = torch.cat([self.values, self.values.new_zeros(1, self.values.shape[1])])
        for corner in range(8):
            step = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=points.device)
            cell = low + step
            inside = ((cell >= 0) & (cell < side)).all(-1)
            cell = cell.clamp(0, side - 1)
            row = torch.where(inside, self.index[cell[:, 0], cell[:, 1], cell[:, 2]].long(), -1)
            weight = torch.where(step.bool(), fraction, 1 - fraction).prod(-1)
            found = padded[row]
            weighted = weight * found[:, 0]
            density = density + weighted
            coefficients = coefficients + weighted[:, None] * found[:, 1:]
        # colour: the mean of the coefficients weighted by density, along the directions
        coefficients = (coefficients / density.clamp_min(1e-8 / self.bounds.radius)[:, None]).reshape(-1, 3, HARMONICS)
        colour = (coefficients * spherical_harmonics(directions)[:, None]).sum(-1)
        return colour.clamp(0, 1), density

    def save(self, path: Path | str) -> None:
        """Write one compact file: a bit per voxel, and for each row a float16 density and a byte per coefficient.

        Bytes divide the range of each coefficient, so pictures change by less than one of 255 grey levels.

        Raises:
            ValueError: an odd number of voxels an axis.
        """
        if self.side % 2:
            raise ValueError(f"side: expected an even number of voxels an axis, got {self.side}")
        packed = torch.from_numpy(np.packbits((self.index >= 0).cpu().numpy(), bitorder="little"))
        order = self.index.flatten()
        rows = self.values[order[order >= 0].long()]
        low, high = rows[:, 1:].aminmax(dim=0) if len(rows) else 2 * (rows.new_zeros(3 * HARMONICS),)
        coefficients = (rows[:, 1:] - low) / (high - low).clamp_min(1e-12) * 255
        density = (rows[:, 0] * self.bounds.radius).clamp_max(torch.finfo(torch.float16).max).half()
        content = {"occupied": packed, "scaled_density": density, "coefficients": coefficients.round().byte()}
        content |= {"range": torch.stack([low, high])}
        content |= {"sphere": torch.tensor([*self.bounds.centre, self.bounds.radius])}
        save_tensors(Path(path), content)

    @classmethod
    def load(cls, path: Path | str) -> BakedField:
        """The field that `save` wrote.

        Raises:
            CheckpointError: a missing or damaged file, or one with other content.
        """
        path = Path(path)
        found = load_tensors(path)
        if {name: value.dtype for name, value in found.items()} != STORED:
            is_model = (path.parent / "model.json").exists()
            remedy = f"give the folder {path.parent} for a model" if is_model else "`hyperplanes bake` writes one"
            names = ", ".join(sorted(found)[:3]) + ", ..." * (len(found) > 3) or "none"
            raise CheckpointError(f"{path}: expected a baked field, found other tensors ({names:.80}); {remedy}")
        bits = torch.from_numpy(np.unpackbits(found["occupied"].numpy(), bitorder="little")).bool()
        side, rows, numbers = round(len(bits) ** (1 / 3)), int(bits.sum()), 3 * HARMONICS
        shapes = {"scaled_density": (rows,), "coefficients": (rows, numbers), "range": (2, numbers), "sphere": (4,)}
        if side**3 != len(bits) or side > LARGEST_SIDE or any(found[n].shape != shape for n, shape in shapes.items()):
            raise CheckpointError(
                f"{path}: expected a cube of voxels and {rows} rows of 1 + {numbers} numbers, found {len(bits)} voxels "
                f"and {', '.join(f'{name} {tuple(found[name].shape)}' for name in shapes)}; bake again"
            )
        low, high = found["range"]
        coefficients = low + (high - low) / 255 * found["coefficients"].float()
        index = torch.full((len(bits),), -1, dtype=torch.int32)
        index[bits] = torch.arange(rows, dtype=torch.int32)
        x, y, z, radius = found["sphere"].tolist()
        if not radius > 0:
            raise CheckpointError(f"{path}: expected a sphere of positive radius, found {radius:g}; bake again")
        values = torch.cat([found["scaled_density"].float()[:, None] / radius, coefficients], 1)
        return cls(index.reshape(side, side, side), values, Sphere((x, y, z), radius))
