"""The training of a correction network, which computes the residual correction of the pictures of a trained model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from hyperplanes.adaptation.correction.residuals import ResidualField
from hyperplanes.adaptation.correction_network import CANDIDATES, COLOUR, DEVIATIONS, OPACITY, CorrectionNetwork
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.utilities.tensors.seeding import seeded
from hyperplanes.views import Task, Views

__all__ = ["CorrectionExample", "disturbed", "example_of", "fit_correction", "recoloured"]

CORRECTION_STEPS = 6000
PICTURES_PER_STEP, CROP = 6, 96  # pictures per step, and pixels a side of the part that is used
SEED = 0  # of the initial weights and the random draws
RATE, WARMUP, LAST = 2e-3, 50, 0.02  # learning rate of AdamW, steps of warm-up, and the final rate as a fraction
WEIGHT_DECAY = 1e-4
LEAST_CONTRAST = 0.7  # of random colours: of all channels, and of single ones once more
MIN_ERROR = 1e-5  # added to squared errors before the logarithm: 50 dB


@dataclass(frozen=True)
class CorrectionExample:
    """The query views of one object.

    Attributes:
        read: the inputs of the correction network, in half precision.
        truth: the true pictures.
    """

    read: Float[Tensor, "view 16 height width"]
    truth: Float[Tensor, "view 3 height width"]


def disturbed(views: Views, degrees: float, generator: torch.Generator) -> Views:
    """The views with small errors of their poses, as those of photographs have.

    Args:
        views: of an object, with cameras without distortion.
        degrees: angle of the rotation of each camera about a random axis. It is also moved, by a normally distributed
            offset whose standard deviation is as many degrees seen from the centre at the radius of the scene.
        generator: of axes and offsets, on the CPU.
    """
    cameras = views.cameras
    poses, angle = cameras.extrinsics.clone(), torch.tensor(degrees).deg2rad()
    axes, offsets = (torch.randn(len(views), 3, generator=generator, dtype=torch.float64).to(poses) for _ in range(2))
    poses[:, :3] = axis_angle_to_rotation_matrix(torch.nn.functional.normalize(axes, dim=1) * angle) @ poses[:, :3]
    poses[:, :3, 3] += offsets * angle * views.bounds.radius
    return replace(views, cameras=PinholeCamera(cameras.intrinsics, poses, cameras.height, cameras.width))


def recoloured(views: Views, spread: float, generator: torch.Generator) -> Views:
    """The views with errors of exposure and white balance, and noise, as photographs have.

    Args:
        views: of an object, with masks.
        spread: standard deviation of the logarithm of the exposure of a view. That of each channel differs by a third
            of it, and the standard deviation of the noise of a pixel is a tenth.
        generator: of the errors, on the CPU.

    Raises:
        ValueError: views without masks.
    """
    if views.masks is None:
        raise ValueError("views: expected masks, got none")

    def draw(*shape: int) -> Tensor:
        return spread * torch.randn(shape, generator=generator).to(views.images)

    background = 1 - views.masks
    gains = (draw(len(views), 1, 1, 1) + draw(len(views), 3, 1, 1) / 3).exp()
    noise = views.masks * draw(*views.images.shape) / 10
    object_colours = (gains * (views.images - background) + noise).clamp_min(0).minimum(views.masks)
    return replace(views, images=object_colours + background)


def example_of(model: HyperPlanes, task: Task, steps: int = 0) -> CorrectionExample | None:
    """The training example of one object; None if a query view shows nothing that a support view sees.

    Args:
        model: the model whose pictures are corrected.
        task: an object with masks, which the model was not trained on.
        steps: gradient steps on the support views.
    """
    adapted = model.fine_tune(task.support, steps) if steps else model.adapt(task.support)
    field, query = adapted.without_residuals(), task.query
    residuals, pictures = ResidualField(field, model.to_own(task.support)), field.render(query.cameras)
    read = [residuals.readings(pictures, query.cameras, view) for view in range(len(query))]
    found = [each for each in read if each is not None]
    return CorrectionExample(torch.stack(found).half(), query.images) if len(found) == len(query) else None


def fit_correction(
    examples: Sequence[CorrectionExample],
    *,
    steps: int = CORRECTION_STEPS,
    start: CorrectionNetwork | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> CorrectionNetwork:
    """Train a correction network with AdamW on the PSNR of parts of pictures.

    These are rotated, mirrored and recoloured randomly.

    Args:
        examples: examples of objects, with all numbers of support views.
        steps: number of steps, each on PICTURES_PER_STEP random pictures.
        start: a network that the training continues from; by default random weights.
        on_step: called with the number of steps done, and how many decibels the pictures of the last step are better
            than without correction.

    Raises:
        ValueError: no example.
    """
    if not examples:
        raise ValueError("examples: expected at least one, got none")
    with seeded(SEED):
        network = CorrectionNetwork().requires_grad_()
    if start is not None:
        network.load_state_dict(start.state_dict())
    descent = torch.optim.AdamW(network.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    warmup = torch.optim.lr_scheduler.LinearLR(descent, 1 / WARMUP, total_iters=WARMUP)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(descent, max(1, steps - WARMUP), RATE * LAST)
    schedule = torch.optim.lr_scheduler.SequentialLR(descent, [warmup, cosine], [WARMUP])
    generator = torch.Generator().manual_seed(SEED)
    for step in range(steps):
        chosen = torch.randint(len(examples), (PICTURES_PER_STEP,), generator=generator).tolist()
        losses, gains = [], []
        for place in chosen:
            read, truth = _part(examples[place], generator)
            plain = read[:, COLOUR] + 0.5
            losses.append(_log_error(plain + network(read), truth))
            gains.append(_log_error(plain, truth) - losses[-1].detach())
        descent.zero_grad()
        torch.stack(losses).mean().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        descent.step()
        schedule.step()
        if on_step is not None:
            on_step(step + 1, float(torch.stack(gains).mean()) * 10 / math.log(10))
    return network.requires_grad_(requires_grad=False)


def _part(example: CorrectionExample, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A random part of a random picture around a pixel of the object, rotated and mirrored."""

    def draw(count: int) -> int:
        return int(torch.randint(count, (1,), generator=generator))

    view = draw(len(example.read))
    read, truth = example.read[view], example.truth[view]
    seen = (read[OPACITY][0] > 0).nonzero()
    corner = [0, 0]
    if len(seen):
        pixel = seen[draw(len(seen))].tolist()
        corner = [
            min(max(0, place - draw(CROP)), max(0, size - CROP))
            for place, size in zip(pixel, truth.shape[1:], strict=True)
        ]
    top, left = corner
    parts = [each[:, top : top + CROP, left : left + CROP].float() for each in (read, truth)]
    turns, mirrored = draw(4), draw(2)
    parts = [each.rot90(turns, (1, 2)) for each in parts]
    read, truth = (each.flip(2) if mirrored else each for each in parts)
    return _with_random_colours(read, truth, generator)


def _with_random_colours(read: Tensor, truth: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The picture with permuted channels, each with another contrast to the white background."""
    order = torch.randperm(3, generator=generator)
    contrast = LEAST_CONTRAST + (1 - LEAST_CONTRAST) * torch.rand(4, generator=generator)
    contrast = (contrast[0] * contrast[1:])[:, None, None]
    read = read.clone()
    read[COLOUR] = 0.5 - contrast * (0.5 - read[COLOUR][order])
    read[CANDIDATES] = (contrast * read[CANDIDATES].unflatten(0, (-1, 3))[:, order]).flatten(0, 1)
    read[DEVIATIONS] *= contrast.square().mean().sqrt()
    return read[None], 1 - contrast * (1 - truth[None, order])


def _log_error(image: Tensor, truth: Tensor) -> Tensor:
    return ((image - truth).square().mean() + MIN_ERROR).log()
