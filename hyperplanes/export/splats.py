"""Gaussian splats of baked voxels: one a voxel, fitted to posed images, in the files that viewers read.

Axes: viewers of splats show files as the original code wrote them, whose world has y down, as COLMAP's often has. Files
are therefore turned half about x: what has y up here stands upright there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.fields.baked import HARMONICS, BakedField, spherical_harmonics
from hyperplanes.geometry import cameras as camera
from hyperplanes.rendering.splats import render_splats, splat_gradients
from hyperplanes.utilities.arguments import checked
from hyperplanes.utilities.files import format_of
from hyperplanes.utilities.writing import write_whole
from hyperplanes.views import Views

__all__ = ["SPLAT_FORMATS", "Splats", "fit_splats", "save_splats", "splats_of"]

SPLAT_FORMATS = ("ply", "splat")
SIZE = 0.6  # standard deviation of a splat, in voxels
STEPS = 100
RATES = 0.02, 0.1  # of coefficients of colour, and of logits of opacity
MEAN = 0.28209479  # the first harmonic
HALF_TURN = (1, -1, -1, 1, -1, 1, 1, -1, 1)  # of the harmonics under (x, y, z) -> (x, -y, -z)


@dataclass(frozen=True)
class Splats:
    """Isotropic Gaussians.

    Attributes:
        means: in the world.
        sizes: standard deviations in world units.
        logits: of the opacities at the centres.
        coefficients: of colour, red first, as those of a `BakedField`.
    """

    means: Float[Tensor, "splat 3"]
    sizes: Float[Tensor, " splat"]
    logits: Float[Tensor, " splat"]
    coefficients: Float[Tensor, "splat 27"]

    def colours(self, cameras: PinholeCamera) -> Float[Tensor, "splat 3"]:
        """As one camera sees them, in [0, 1]; a batch of one."""
        directions = torch.nn.functional.normalize(self.means - camera.centres(cameras), dim=-1)
        basis = spherical_harmonics(directions)[:, None]
        return (self.coefficients.reshape(-1, 3, HARMONICS) * basis).sum(-1).clamp(0, 1)

    @torch.no_grad()
    def render(self, cameras: PinholeCamera) -> Float[Tensor, "view 3 height width"]:
        """Their pictures over white."""
        opacities, each = self.logits.sigmoid(), range(cameras.batch_size)
        ones = [camera.select(cameras, [view]) for view in each]
        return torch.stack([render_splats(self.means, self.sizes, opacities, self.colours(one), one) for one in ones])


@checked
def splats_of(baked: BakedField) -> Splats:
    """One splat a voxel, as opaque as the voxel is and with its colours."""
    places = (baked.index >= 0).nonzero()
    rows = baked.values[baked.index[baked.index >= 0].long()]
    voxel = 2 * baked.bounds.radius / baked.side
    means = (places.float() + 0.5) * voxel + (torch.tensor(baked.bounds.centre) - baked.bounds.radius)
    opacity = (1 - torch.exp(-rows[:, 0] * voxel)).clamp(0.004, 0.98)
    return Splats(means, torch.full((len(means),), SIZE * voxel), torch.logit(opacity), rows[:, 1:].clone())


@checked
def fit_splats(
    splats: Splats, views: Views, *, steps: int = STEPS, seed: int = 0, on_step: Callable[[int], None] | None = None
) -> Splats:
    """The splats after gradient steps (Adam) on their opacities and colours, one view a step.

    Args:
        splats: where it starts.
        views: posed images of the object, without lens distortion.
        steps: gradient steps.
        seed: of the order of the views.
        on_step: told the number of steps done.

    Returns:
        Splats at the same places.
    """
    views = views.to("cpu", torch.float32)
    coefficients = splats.coefficients.clone().requires_grad_()
    logits = splats.logits.clone().requires_grad_()
    groups = [{"params": [coefficients], "lr": RATES[0]}, {"params": [logits], "lr": RATES[1]}]
    descent = torch.optim.Adam(groups, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.ExponentialLR(descent, 0.1 ** (1 / max(1, steps)))
    generator = torch.Generator().manual_seed(seed)
    order = torch.cat([torch.randperm(len(views), generator=generator) for _ in range(-(-steps // len(views)))])
    for step, view in enumerate(order[:steps].tolist()):
        one = camera.select(views.cameras, [view])
        now = replace(splats, coefficients=coefficients, logits=logits)
        colours, opacities = now.colours(one), logits.sigmoid()
        _, *gradients = splat_gradients(
            splats.means, splats.sizes, opacities.detach(), colours.detach(), one, views.images[view]
        )
        descent.zero_grad()
        torch.autograd.backward([opacities, colours], gradients)
        descent.step()
        schedule.step()
        if on_step:
            on_step(step + 1)
    return replace(splats, coefficients=coefficients.detach(), logits=logits.detach())


@checked
def save_splats(splats: Splats, path: str | Path) -> Path:
    """Write splats as PLY, which every viewer reads, or in the smaller format .splat, which has no colour by direction.

    Args:
        splats: with y up; the file has y down, see the module.
        path: ends in .ply or .splat.

    Returns:
        The file. Another ending is a ValueError.
    """
    path = Path(path)
    kind = format_of(path, SPLAT_FORMATS)
    turned = replace(
        splats,
        means=splats.means * torch.tensor([1.0, -1.0, -1.0]),
        coefficients=(splats.coefficients.reshape(-1, 3, HARMONICS) * torch.tensor(HALF_TURN)).flatten(1),
    )
    write_whole(path, _ply(turned) if kind == "ply" else _splat(turned))
    return path


def _ply(splats: Splats) -> bytes:
    """The original code's properties: harmonics up to degree 3, of which the last are zero, and logarithms of sizes."""
    number = len(splats.means)
    coefficients = splats.coefficients.reshape(number, 3, HARMONICS)
    rest = torch.cat([coefficients[..., 1:], torch.zeros(number, 3, 16 - HARMONICS)], -1).flatten(1)
    columns = {
        "x y z": splats.means,
        "nx ny nz": torch.zeros(number, 3),
        "f_dc_0 f_dc_1 f_dc_2": coefficients[..., 0] - 0.5 / MEAN,
        " ".join(f"f_rest_{place}" for place in range(45)): rest,
        "opacity": splats.logits[:, None],
        "scale_0 scale_1 scale_2": splats.sizes.log()[:, None].expand(-1, 3),
        "rot_0 rot_1 rot_2 rot_3": torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(number, 4),
    }
    names = "".join(f"property float {name}\n" for names in columns for name in names.split())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {number}\n{names}end_header\n"
    return header.encode() + torch.cat(list(columns.values()), 1).numpy().astype("<f4").tobytes()


def _splat(splats: Splats) -> bytes:
    """32 bytes a splat: place, sizes, colour with opacity, and rotation; the most visible ones first."""
    kind = np.dtype([("mean", "<f4", 3), ("size", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])
    opacity = splats.logits.sigmoid()
    colour = splats.coefficients.reshape(-1, 3, HARMONICS)[..., 0] * MEAN
    content = np.zeros(len(splats.means), kind)
    content["mean"] = splats.means.numpy()
    content["size"] = splats.sizes[:, None].numpy()
    shown = torch.cat([colour, opacity[:, None]], 1).clamp(0, 1) * 255
    content["colour"] = shown.round().byte().numpy()
    content["rotation"] = [255, 128, 128, 128]  # 128 + 128 times the quaternion (1, 0, 0, 0)
    return content[np.argsort(-(splats.sizes**3 * opacity).numpy(), kind="stable")].tobytes()
