"""The forward pass of a training step for one object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.rays import SUBPIXELS
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.training.episodes import Draw, Episode
from hyperplanes.training.episodes.augmentation import drop_planes, over_random_colour
from hyperplanes.utilities.messages.errors import prefix_errors

__all__ = ["ForwardOutput", "forward"]


@dataclass(frozen=True)
class ForwardOutput:
    """The result of the forward pass for one object, from which the losses are computed.

    Attributes:
        episode: the object and its views.
        parameters: theta + delta.
        field: the field with these parameters and the planes that were not dropped.
        rendered: the rendered query rays.
        truth: the true colours of these rays.
        generator: the generator of this step and object, for losses that draw random numbers.
    """

    episode: Episode
    parameters: Parameters
    field: AdaptedField
    rendered: Rendered
    truth: Float[Tensor, "ray 3"]
    generator: torch.Generator


def forward(model: HyperPlanes, draw: Draw, update: Parameters, config: TrainingConfig) -> ForwardOutput:
    """Render random query rays of one object with its adapted weights (HyperPlanes, Algorithm 1).

    Args:
        model: the model that is trained.
        draw: the object, and the generator of its rays, samples and augmentations, in the order below.
        update: delta of this object, which the hypernetwork has predicted.
        config: the configuration of the training.
    """
    episode, generator = draw.episode, draw.generator
    # plane dropout, if it is configured
    prepared = drop_planes(episode.prepared, model.config.plane_dropout, generator)
    # the field of theta + delta, which reads colours from the planes (Eq. 6)
    parameters = model.theta + update
    field = model.field(prepared, parameters)
    # random rays of the query views, with their true colours and opacities
    subpixels = SUBPIXELS if config.antialias else SUBPIXELS[:1]
    with record_function("step:rays"), prefix_errors(draw.name):
        rays, truth, opacity = episode.query.sample_masked_rays(
            config.rays, generator=generator, among=episode.live, near_far=field.sampling.near_far, subpixels=subpixels
        )
    # place samples on the rays, evaluate the field there, and composite (Eq. 1)
    with record_function("step:rendering"):
        rendered = field.trace(rays, generator).pooled(len(subpixels))
    # the same random background behind prediction and truth
    if config.random_background:
        rendered, truth = over_random_colour(rendered, truth, opacity, generator)
    return ForwardOutput(episode, parameters, field, rendered, truth, generator)
