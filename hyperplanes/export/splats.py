"""Gaussian splats from baked voxels, one a voxel, fitted to posed images and written for common viewers.

Axes: splat viewers expect y down, like the original code and often COLMAP. Files are therefore rotated by a half turn
about x, so that an object with y up here stands upright there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.fields.baked import FIRST_HARMONIC, HARMONICS, BakedField, spherical_harmonics
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.rendering.splats import render_splats
from hyperplanes.utilities.files.reading import format_of
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.uncompiled_optimisers import Adam
from hyperplanes.views import Views, join_views

__all__ = ["SPLAT_FORMATS", "Splats", "fit_splats", "save_splats", "splats_of"]

SPLAT_FORMATS = ("ply", "splat")
INITIAL_SCALE = 0.45  # standard deviation of a splat before fitting, in voxels
SPLAT_STEPS = 160
LEARNING_RATES = {"means": 0.3, "scales": 0.06, "quaternions": 0.06, "logits": 0.4, "coefficients": 0.02}
"""Initial learning rates: of means in units of the splats' size, of scales as logarithms."""

DIRECTIONAL = 0.2  # learning rate of view-dependent coefficients, relative to that of the mean colour
# largest contribution to a picture, in pixels, below which a splat counts as hidden and is left out
MIN_CONTRIBUTION = 0.1
SURROUNDING_CAMERAS = 16  # cameras from all sides, beside the views, that decide which splats are hidden
HALF_TURN = (1, -1, -1, 1, -1, 1, 1, -1, 1)  # signs of the harmonics under (x, y, z) -> (x, -y, -z)


@dataclass(frozen=True)
class Splats:
    """Gaussian splats.

    Attributes:
        means: in the world.
        scales: standard deviations along the axes of each, in world units.
        quaternions: rotations of these axes, real part first, of any length.
        logits: logits of the opacities at the centres.
        coefficients: colour coefficients, red first, as in `BakedField`.
    """

    means: Float[Tensor, "splat 3"]
    scales: Float[Tensor, "splat 3"]
    quaternions: Float[Tensor, "splat 4"]
    logits: Float[Tensor, " splat"]
    coefficients: Float[Tensor, "splat 27"]

    def __getitem__(self, chosen: Bool[Tensor, " splat"]) -> Splats:
        return Splats(*(getattr(self, part.name)[chosen] for part in fields(self)))

    def colours(self, cameras: PinholeCamera) -> Float[Tensor, "splat 3"]:
        """The colours seen by one camera (a batch of one), at least 0."""
        directions = torch.nn.functional.normalize(self.means - camera.centres(cameras), dim=-1)
        basis = spherical_harmonics(directions)[:, None]
        return (self.coefficients.reshape(-1, 3, HARMONICS) * basis).sum(-1).clamp_min(0)

    def picture(self, cameras: PinholeCamera) -> Float[Tensor, "3 height width"]:
        """The picture of one camera (a batch of one) over white, differentiable."""
        shape = self.means, self.scales, self.quaternions, self.logits.sigmoid()
        return render_splats(*shape, self.colours(cameras), cameras)

    @torch.no_grad()
    def render(self, cameras: PinholeCamera) -> Float[Tensor, "view 3 height width"]:
        """The pictures of all cameras over white."""
        return torch.stack([self.picture(camera.select(cameras, [view])) for view in range(cameras.batch_size)])


@checked
def splats_of(baked: BakedField) -> Splats:
    """One round splat a voxel, with its opacity and colours."""
    filled = Occupancy(baked.index >= 0, baked.bounds)
    rows = baked.values[baked.index[filled.occupied].long()]
    means, voxel = filled.centres(), filled.voxel
    opacity = (1 - torch.exp(-rows[:, 0] * voxel)).clamp(0.004, 0.98)
    unturned = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1)
    scales = torch.full((len(means), 3), INITIAL_SCALE * voxel)
    return Splats(means, scales, unturned, torch.logit(opacity), rows[:, 1:].clone())


@checked
def fit_splats(
    splats: Splats,
    views: Views,
    *,
    guide: Views | None = None,
    steps: int = SPLAT_STEPS,
    on_step: Callable[[int], None] | None = None,
) -> Splats:
    """The visible splats after gradient steps (Adam) on all their parameters, one view a step.

    On cars of 100 x 100 pixels with 25 support views, round splats with only opacities and colours fitted had 8 dB less
    on other views than their voxels. Three quarters of them were hidden.

    Fitted to a few views alone, splats overfit, as voxels do. With the guide, example-car at 64 x 64 pixels has 25.8 dB
    on other views instead of 22.5 with three support views, and 27.0 instead of 24.7 with six.

    Args:
        splats: the initial splats.
        views: posed images of the object, without lens distortion.
        guide: renderings of the voxels from other places, `render_guide(..., size=views.size)`; views like the others.
        steps: gradient steps.
        on_step: called with the number of steps done.

    Returns:
        At most as many splats; the given ones if there are no steps.

    Raises:
        ValueError: no views, cameras with lens distortion, or a guide of another size.
    """
    if not len(views) or isinstance(views.cameras, DistortedCamera):
        found = "some with it" if len(views) else "none"
        raise ValueError(f"views: expected at least one without lens distortion, got {found}")
    if guide is not None and guide.size != views.size:
        raise ValueError(
            f"guide: expected renderings of the views' size {views.size}, got {guide.size}; "
            "make them by render_guide(..., size=views.size)"
        )
    if not steps:
        return splats
    views = views.to("cpu", torch.float32)
    if guide is not None:
        views = join_views(replace(views, masks=None), guide.to("cpu", torch.float32))
    splats = splats[_weights(splats, views) > MIN_CONTRIBUTION]
    size = float(splats.scales.mean()) if len(splats.scales) else 1.0
    # offsets of all parameters from their initial values, each kind with its learning rate
    free = {name: torch.zeros_like(getattr(splats, name)).requires_grad_() for name in LEARNING_RATES}
    descent = Adam([{"params": [free[name]], "lr": LEARNING_RATES[name]} for name in LEARNING_RATES], betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.ExponentialLR(descent, 0.1 ** (1 / steps))

    rate = torch.tensor([1.0] + [DIRECTIONAL] * (HARMONICS - 1)).repeat(3)

    def moved() -> Splats:
        return Splats(
            splats.means + size * free["means"],
            splats.scales * free["scales"].exp(),
            splats.quaternions + free["quaternions"],
            splats.logits + free["logits"],
            splats.coefficients + free["coefficients"] * rate,
        )

    generator = torch.Generator().manual_seed(0)
    # every view equally often, in random order
    order = torch.cat([torch.randperm(len(views), generator=generator) for _ in range(-(-steps // len(views)))])
    for step, view in enumerate(order[:steps].tolist()):
        picture = moved().picture(camera.select(views.cameras, [view]))
        descent.zero_grad()
        (picture - views.images[view]).square().mean().backward()
        descent.step()
        schedule.step()
        if on_step:
            on_step(step + 1)
    with torch.no_grad():
        return moved()


def _weights(splats: Splats, views: Views) -> Float[Tensor, " splat"]:
    """Each splat's compositing weights summed over a picture: the largest sum of all views and cameras around.

    A weight is the derivative of a pixel with respect to the splat's colour.
    """
    bounds, found = views.bounds, torch.zeros(len(splats.means))
    centre = torch.tensor(bounds.centre)
    distance = float((camera.centres(views.cameras) - centre).norm(dim=-1).median())
    around = camera.fibonacci_sphere(SURROUNDING_CAMERAS, max(distance, 1.1 * bounds.radius))
    around[:, :3, 3] -= around[:, :3, :3] @ centre
    others = camera.with_poses(camera.select(views.cameras, [0] * SURROUNDING_CAMERAS), around)
    shape = splats.means, splats.scales, splats.quaternions, splats.logits.sigmoid()
    for cameras in (views.cameras, others):
        for view in range(cameras.batch_size):
            black = torch.zeros(len(found), 3, requires_grad=True)
            render_splats(*shape, black, camera.select(cameras, [view]))[0].sum().backward()
            found = torch.maximum(found, black.grad[:, 0]) if black.grad is not None else found
    return found


@checked
def save_splats(splats: Splats, path: str | Path) -> Path:
    """Write splats as PLY, which every viewer reads, or as .splat, which is smaller but has no view-dependent colour.

    Args:
        splats: with y up; the file has y down (see the module).
        path: ends in .ply or .splat.

    Returns:
        The file. Another ending is a ValueError.
    """
    path = Path(path)
    kind = format_of(path, SPLAT_FORMATS)
    w, x, y, z = splats.quaternions.unbind(-1)
    turned = replace(
        splats,
        means=splats.means * torch.tensor([1.0, -1.0, -1.0]),
        quaternions=torch.nn.functional.normalize(torch.stack([-x, w, -z, y], -1), dim=-1),  # after a half turn about x
        coefficients=(splats.coefficients.reshape(-1, 3, HARMONICS) * torch.tensor(HALF_TURN)).flatten(1),
    )
    write_whole(path, _ply(turned) if kind == "ply" else _splat(turned))
    return path


def _ply(splats: Splats) -> bytes:
    """The original code's properties: harmonics up to degree 3, the last of them zero, and logarithms of scales."""
    number = len(splats.means)
    coefficients = splats.coefficients.reshape(number, 3, HARMONICS)
    rest = torch.cat([coefficients[..., 1:], torch.zeros(number, 3, 16 - HARMONICS)], -1).flatten(1)
    columns = {
        "x y z": splats.means,
        "nx ny nz": torch.zeros(number, 3),
        "f_dc_0 f_dc_1 f_dc_2": coefficients[..., 0] - 0.5 / FIRST_HARMONIC,
        " ".join(f"f_rest_{place}" for place in range(45)): rest,
        "opacity": splats.logits[:, None],
        "scale_0 scale_1 scale_2": splats.scales.log(),
        "rot_0 rot_1 rot_2 rot_3": splats.quaternions,
    }
    names = "".join(f"property float {name}\n" for names in columns for name in names.split())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {number}\n{names}end_header\n"
    return header.encode() + torch.cat(list(columns.values()), 1).numpy().astype("<f4").tobytes()


def _splat(splats: Splats) -> bytes:
    """32 bytes a splat: position, scales, colour with opacity, and rotation; the most visible ones first."""
    kind = np.dtype([("mean", "<f4", 3), ("size", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])
    opacity = splats.logits.sigmoid()
    colour = splats.coefficients.reshape(-1, 3, HARMONICS)[..., 0] * FIRST_HARMONIC
    content = np.zeros(len(splats.means), kind)
    content["mean"] = splats.means.numpy()
    content["size"] = splats.scales.numpy()
    shown = torch.cat([colour, opacity[:, None]], 1).clamp(0, 1) * 255
    content["colour"] = shown.round().byte().numpy()
    content["rotation"] = (splats.quaternions * 128 + 128).round().clamp(0, 255).byte().numpy()
    return content[np.argsort(-(splats.scales.prod(1) * opacity).numpy(), kind="stable")].tobytes()
