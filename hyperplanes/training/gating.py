"""The training of a gating network, after that of the model whose pictures it mixes with those of the visual hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from hyperplanes.adaptation.gating import GatingNetwork, readings
from hyperplanes.adaptation.held_out import hold_out
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.stacking import hull_field, hull_share
from hyperplanes.utilities.seeding import seeded
from hyperplanes.views import Task, moved

__all__ = ["GatingExample", "example_of", "fit_gate", "turned"]

STEPS = 1500
EXAMPLES, PIXELS = 16, 2048  # of a step, and of each of them
SEED = 0  # of the weights and the draws
RATE = 0.01  # of Adam, at first; it falls to nothing by a cosine


@dataclass(frozen=True)
class GatingExample:
    """Pixels of one object that is shown by some views, of those where either picture has anything.

    Attributes:
        read: what the gating network reads of them.
        learned: by the learned field.
        hull: by the visual hull.
        truth: as they are.
        error: sum of squared errors of the learned field over all pixels, by which those of the mean are divided.
    """

    read: Float[Tensor, "pixel 9"]
    learned: Float[Tensor, "pixel 3"]
    hull: Float[Tensor, "pixel 3"]
    truth: Float[Tensor, "pixel 3"]
    error: float


@torch.no_grad()
def example_of(model: HyperPlanes, task: Task) -> GatingExample:
    """The pixels of an object's query views.

    Args:
        model: whose pictures are mixed with those of the hull.
        task: an object that the model was not trained on, with masks.
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
    """An object in a random orientation, as none of its kind stands: cameras are turned about the scene's centre."""
    quaternion = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = quaternion_to_rotation_matrix(quaternion[None])[0]
    centre = torch.tensor(task.support.bounds.centre, dtype=torch.float64)
    motion[:3, 3] = centre - motion[:3, :3] @ centre

    return replace(task, support=moved(task.support, motion), query=moved(task.query, motion))


def fit_gate(examples: Sequence[GatingExample], *, steps: int = STEPS) -> GatingNetwork:
    """A gating network by gradient steps (Adam) on the squared error of means of two pictures.

    Each example counts by its error relative to that of the learned field, so that PSNR rises on all alike.

    Args:
        examples: of objects, shown by all numbers of views; those of which neither picture shows anything are left out.
        steps: of EXAMPLES drawn examples and PIXELS pixels of each.

    Raises:
        ValueError: no example.
    """
    examples = [each for each in examples if len(each.read)]
    if not examples:
        raise ValueError("examples: expected one of which a picture shows anything, got none")
    with seeded(SEED):
        gate = GatingNetwork().requires_grad_()
    descent = torch.optim.Adam(gate.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(descent, steps)
    generator = torch.Generator().manual_seed(SEED)
    for _ in range(steps):
        drawn = [examples[place] for place in torch.randint(len(examples), (EXAMPLES,), generator=generator).tolist()]
        loss = torch.stack([_relative_error(gate, each, generator) for each in drawn]).mean()
        descent.zero_grad()
        loss.backward()
        descent.step()
        schedule.step()
    return gate.requires_grad_(requires_grad=False)


def _relative_error(gate: GatingNetwork, example: GatingExample, generator: torch.Generator) -> Tensor:
    """The squared error of the mean of both pictures over that of the first, by some of the pixels."""
    pixels = torch.randint(len(example.read), (PIXELS,), generator=generator)
    share = gate(example.read[pixels])[:, None]
    mixed = torch.lerp(example.learned[pixels], example.hull[pixels], share)
    return (mixed - example.truth[pixels]).square().sum() * (len(example.read) / PIXELS / example.error)


def _flat(images: Float[Tensor, "view 3 height width"]) -> Float[Tensor, "pixel 3"]:
    return images.permute(0, 2, 3, 1).reshape(-1, 3)
