"""The training of a gating network, which averages the pictures of a trained model with those of the visual hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from hyperplanes.adaptation.correction.held_out import hold_out
from hyperplanes.adaptation.correction.stacking import hull_field, hull_share
from hyperplanes.adaptation.gating import GatingNetwork, readings
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.utilities.tensors.seeding import seeded
from hyperplanes.views import Task, moved

__all__ = ["GatingExample", "example_of", "fit_gate", "turned"]

GATE_STEPS = 1500
EXAMPLES_PER_STEP, PIXELS_PER_EXAMPLE = 16, 2048  # examples per step, and pixels of each
SEED = 0  # of the initial weights and the random draws
RATE = 0.01  # initial learning rate of Adam; it decays to 0 along a cosine


@dataclass(frozen=True)
class GatingExample:
    """The pixels of the query views of one object in which the learned field or the visual hull is not transparent.

    Attributes:
        read: the inputs of the gating network for these pixels.
        learned: their colours, by the learned field.
        hull: their colours, by the visual hull.
        truth: their true colours.
        error: sum of the squared errors of the learned field over all pixels of the query views; at least 1e-6.
    """

    read: Float[Tensor, "pixel 9"]
    learned: Float[Tensor, "pixel 3"]
    hull: Float[Tensor, "pixel 3"]
    truth: Float[Tensor, "pixel 3"]
    error: float


@torch.no_grad()
def example_of(model: HyperPlanes, task: Task) -> GatingExample:
    """The training example of one object.

    Args:
        model: the model whose pictures are averaged with those of the hull.
        task: an object with masks, which the model was not trained on.
    """
    context = model.prepare(task.support)
    learned = model.rendering_field(context, model.adapted_weights(context)).render(task.query.cameras)
    hull = hull_field(context).render(task.query.cameras)
    share, truth = hull_share(hold_out(model, context.views)), _flat(task.query.images)
    one, other = _flat(learned.images), _flat(hull.images)
    opacity, of_hull = learned.opacity.flatten(), hull.opacity.flatten()
    some = (opacity > 0) | (of_hull > 0)
    read = readings(one[some], other[some], opacity[some], of_hull[some], share, len(context.views))
    error = float((one - truth).square().sum().clamp_min(1e-6))
    return GatingExample(read, one[some], other[some], truth[some], error)


def turned(task: Task, generator: torch.Generator) -> Task:
    """The object in a uniformly random orientation: its cameras are rotated about the centre of the scene."""
    quaternion = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = quaternion_to_rotation_matrix(quaternion[None])[0]
    centre = torch.tensor(task.support.bounds.centre, dtype=torch.float64)
    motion[:3, 3] = centre - motion[:3, :3] @ centre

    return replace(task, support=moved(task.support, motion), query=moved(task.query, motion))


def fit_gate(examples: Sequence[GatingExample], *, steps: int = GATE_STEPS) -> GatingNetwork:
    """Train a gating network with Adam on the squared error of the average of two pictures.

    The error of each example is divided by that of its learned field, so that all objects have the same weight in PSNR.

    Args:
        examples: examples of objects, with all numbers of support views. Those without pixels are left out.
        steps: number of steps, each on EXAMPLES_PER_STEP random examples and PIXELS_PER_EXAMPLE pixels of each.

    Raises:
        ValueError: no example with a pixel.
    """
    examples = [each for each in examples if len(each.read)]
    if not examples:
        raise ValueError("examples: expected at least one example with a pixel, got none")
    with seeded(SEED):
        gate = GatingNetwork().requires_grad_()
    descent = torch.optim.Adam(gate.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(descent, steps)
    generator = torch.Generator().manual_seed(SEED)
    for _ in range(steps):
        drawn = [
            examples[place]
            for place in torch.randint(len(examples), (EXAMPLES_PER_STEP,), generator=generator).tolist()
        ]
        loss = torch.stack([_relative_error(gate, each, generator) for each in drawn]).mean()
        descent.zero_grad()
        loss.backward()
        descent.step()
        schedule.step()
    return gate.requires_grad_(requires_grad=False)


def _relative_error(gate: GatingNetwork, example: GatingExample, generator: torch.Generator) -> Tensor:
    """The squared error of the average of both pictures, divided by that of the learned field; from random pixels."""
    pixels = torch.randint(len(example.read), (PIXELS_PER_EXAMPLE,), generator=generator)
    share = gate(example.read[pixels])[:, None]
    mixed = torch.lerp(example.learned[pixels], example.hull[pixels], share)
    return (mixed - example.truth[pixels]).square().sum() * (len(example.read) / PIXELS_PER_EXAMPLE / example.error)


def _flat(images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "pixel 3"]:
    return images.permute(0, 2, 3, 1).reshape(-1, 3)
