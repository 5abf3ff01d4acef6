"""The forward pass of a step, for one of its objects."""

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
from hyperplanes.utilities.errors import prefix_errors

__all__ = ["ForwardOutput", "forward"]


@dataclass(frozen=True)
class ForwardOutput:
    """What the losses of one object read.

    Attributes:
        episode: the object, as it was drawn.
        parameters: theta + delta.
        field: that these make of the planes that are shown.
        rendered: query rays.
        truth: their colours.
        generator: of the step and object, for a loss that draws something.
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
        model: that is trained.
        draw: the object, and what its rays, samples and augmentations are drawn from, in the order below.
        update: delta of this object, which the hypernetwork has written.
        config: of the training.
    """
    episode, generator = draw.episode, draw.generator
    # hide some of the planes, where the model is trained to do without
    prepared = drop_planes(episode.prepared, model.config.plane_dropout, generator)
    # the field of theta + delta, which looks colours up in the planes (Eq. 6)
    parameters = model.theta + update
    field = model.field(prepared, parameters)
    # random rays of the query views, and the colours and opacities seen there
    subpixels = SUBPIXELS if config.antialias else SUBPIXELS[:1]
    with record_function("step:rays"), prefix_errors(draw.name):
        rays, truth, opacity = episode.query.sample_masked_rays(
            config.rays, generator=generator, among=episode.live, near_far=field.sampling.near_far, subpixels=subpixels
        )
    # samples on the rays, the field at these, and their compositing (Eq. 1)
    with record_function("step:rendering"):
        rendered = field.trace(rays, generator).pooled(len(subpixels))
    # the same random background behind prediction and truth
    if config.random_background:
        rendered, truth = over_random_colour(rendered, truth, opacity, generator)
    return ForwardOutput(episode, parameters, field, rendered, truth, generator)
