"""Learned steps of gradient descent after the forward pass of the hypernetwork."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.adaptation.context import SupportContext, trained_on
from hyperplanes.adaptation.network import GRID_WEIGHT, HyperPlanesNetwork
from hyperplanes.adaptation.optimisation.descent import pixels_of, ray_loss
from hyperplanes.adaptation.optimisation.gradients import summed_gradients
from hyperplanes.configuration.fine_tuning import FINE_VIEWS
from hyperplanes.parameters import Parameters

__all__ = ["grid_gradient", "step_inputs", "take_learned_steps", "updated_weights"]

RAYS_PER_STEP, PARTS = 2048, 4  # rays of a step, and parts that they are divided into, each with other views masked
ONE_IN = 6  # a part masks one view in ONE_IN


def updated_weights(network: HyperPlanesNetwork, context: SupportContext, steps: int | None = None) -> Parameters:
    """The weights of an object for use: theta + delta after the learned steps.

    Args:
        network: the model.
        context: the object.
        steps: as in `take_learned_steps`.
    """
    return take_learned_steps(network, context, network.adapted_weights(context), steps)


def take_learned_steps(
    network: HyperPlanesNetwork, context: SupportContext, weights: Parameters, steps: int | None = None
) -> Parameters:
    """The weights after the learned steps.

    With FINE_VIEWS given views or more, half as many are taken: more gain nothing there (docs/image-based.md).

    Args:
        network: the model.
        context: the object.
        weights: the initial ones.
        steps: number for few views; by default `ModelConfig.learned_steps`.

    Returns:
        The same weights if the model has no learned steps, and for an object without masks or with a single view.
    """
    step = network.learned_step
    if step is None or context.volume is None or context.views.masks is None or len(context.given) < 2:
        return weights
    steps = network.config.learned_steps if steps is None else steps
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps if len(context.given) < FINE_VIEWS else -(-steps // 2)):
        inputs = step_inputs(network, context, weights, RAYS_PER_STEP, generator)
        with torch.no_grad():
            weights = weights + {GRID_WEIGHT: step(*inputs)[0]}
    return weights


def step_inputs(
    network: HyperPlanesNetwork,
    context: SupportContext,
    weights: Parameters,
    rays: int,
    generator: torch.Generator,
    *,
    pixels: Int[Tensor, " pixel"] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The inputs of a `LearnedStep` for one object, with a batch dimension: hull, grid and gradient.

    Args:
        network: the model, whose hypernetwork reads a volume.
        context: the object.
        weights: of its field.
        rays: as in `grid_gradient`.
        generator: as in `grid_gradient`.
        pixels: as in `grid_gradient`.
    """
    assert context.volume is not None
    gradient = grid_gradient(network, context, weights, rays, generator, pixels=pixels)
    return context.volume[None, :1], weights[GRID_WEIGHT][None], gradient[None]


def grid_gradient(
    network: HyperPlanesNetwork,
    context: SupportContext,
    weights: Parameters,
    rays: int,
    generator: torch.Generator,
    *,
    pixels: Int[Tensor, " pixel"] | None = None,
) -> Float[Tensor, "feature x y z"]:
    """The gradient of the mean squared error of random rays of the views of an object in the grid of features.

    The views that rays come from are masked, as in fine-tuning.

    Args:
        network: the model.
        context: the object.
        weights: of its field.
        rays: number of rays.
        generator: of views, rays and samples, on the CPU.
        pixels: flat indices of the pixels that rays are drawn from; by default those that may show the object.

    Returns:
        The gradient; zeros if no ray meets the object.
    """
    views = trained_on(context, context.given)
    if pixels is None:
        pixels = network.live_pixels_of(context, views)
    parts = _masked(len(views), generator)
    generators = [torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator))) for _ in parts]
    grid = weights[GRID_WEIGHT].detach().clone().requires_grad_(True)
    variable = Parameters({**weights.detach(), GRID_WEIGHT: grid})

    def loss(part: int) -> Tensor:
        masked = parts[part].to(views.images.device)
        among = pixels_of(masked, views, pixels)
        if not len(among):
            return 0 * grid.sum()
        field = network.field(context.mask_views(masked) if len(context.views) > 1 else context, variable)
        drawn, truth = views.sample_rays(
            rays // len(parts), generator=generators[part], among=among, near_far=field.sampling.near_far
        )
        return ray_loss(field.trace(drawn, generators[part]), truth) / len(parts)

    thread_safe = network.field(context, variable).thread_safe
    _, (gradient,) = summed_gradients(loss, len(parts), [grid], thread_safe=thread_safe)
    return torch.zeros_like(grid) if gradient is None else gradient


def _masked(count: int, generator: torch.Generator) -> list[Int[Tensor, " masked"]]:
    """The views that each part masks, drawn at random, none a second time before all were drawn."""
    size = max(1, count // ONE_IN)
    order = torch.cat([torch.randperm(count, generator=generator) for _ in range(-(-PARTS * size // count))])
    return list(order[: PARTS * size].split(size))
