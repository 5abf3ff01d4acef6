"""The training of learned steps of gradient descent for a trained model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.optim import Adam

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.network import GRID_WEIGHT, HyperPlanesNetwork, in_use
from hyperplanes.adaptation.optimisation.gradients import summed_gradients
from hyperplanes.adaptation.optimisation.learned_steps import step_inputs
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.hypernetwork import LearnedStep
from hyperplanes.parameters import Parameters
from hyperplanes.training.episodes import Draw, EpisodeLoader
from hyperplanes.training.forward import forward
from hyperplanes.training.losses import photometric_loss
from hyperplanes.training.parallel.distributed import Processes
from hyperplanes.utilities.tensors.seeding import seeded
from hyperplanes.views import Tasks

__all__ = ["fit_learned_step"]

GRADIENT_RAYS = 1024  # of the support views, for the gradient that a learned step reads
MAX_LEARNED_STEPS = 4  # the trained step of an object is its first, or follows one, two or three others
RATE, WARMUP, LAST = 1e-3, 100, 0.02  # learning rate of Adam, steps of warm-up, and the final rate as a fraction


def fit_learned_step(
    model: HyperPlanes, data: Tasks, config: TrainingConfig, *, on_step: Callable[[int, float], None] | None = None
) -> LearnedStep:
    """Train the learned step of a model, whose own weights do not change.

    The loss is the squared error of query rays after a learned step. For each object, this is a random one of its first
    MAX_LEARNED_STEPS steps.

    Args:
        model: a model whose hypernetwork reads a volume. If it has a learned step, the training continues from that.
        data: the objects that the model was trained on, or others.
        config: episodes, rays and the number of training steps. Rates and optimiser are those of this module.
        on_step: called with the number of training steps done and the loss of the last one.

    Returns:
        The network, for the attribute `learned_step` of a model. `learned_steps` in the model's configuration is how
        often it is applied.
    """
    with seeded(config.seed):
        fitted = HyperPlanesNetwork(replace(model.config, learned_steps=1)).learned_step
    assert fitted is not None
    if model.learned_step is not None:
        fitted.load_state_dict(model.learned_step.state_dict())
    fitted = fitted.to(model.rig).requires_grad_()
    optimiser = Adam(fitted.parameters(), RATE, betas=(0.9, 0.99), fused=True)
    loader = EpisodeLoader(model, data, config, Processes.current())
    try:
        for step in range(config.steps):
            loader.expect(step)
            with in_use(model):
                loss = _gradients(model, fitted, loader.batch(step).rendered, config)
            share = (1 + math.cos(math.pi * step / config.steps)) / 2
            factor = min(1, (step + 1) / WARMUP) * (LAST + (1 - LAST) * share)
            optimiser.param_groups[0]["lr"] = RATE * factor
            optimiser.step()
            if on_step is not None:
                on_step(step + 1, loss)
    finally:
        loader.close()
    return fitted.requires_grad_(requires_grad=False)


def _gradients(model: HyperPlanes, fitted: LearnedStep, draws: Sequence[Draw], config: TrainingConfig) -> float:
    """Set the gradients of the learned step for the objects of a training step; returns the mean loss."""
    with torch.no_grad():
        updates = model.updates([draw.episode.prepared for draw in draws])
    started = [_after_others(model, fitted, draw, update) for draw, update in zip(draws, updates, strict=True)]
    with torch.enable_grad():
        written = fitted(*(torch.cat(each) for each in zip(*(inputs for _, inputs in started), strict=True)))
    change = written.detach().requires_grad_()

    def loss(place: int) -> Tensor:
        update = started[place][0] + {GRID_WEIGHT: change[place]}
        return photometric_loss(forward(model, draws[place], update, config)) / len(draws)

    total, (found,) = summed_gradients(loss, len(draws), [change])
    fitted.zero_grad()
    written.backward(found)
    return float(total)


def _after_others(
    model: HyperPlanes, fitted: LearnedStep, draw: Draw, update: Parameters
) -> tuple[Parameters, tuple[Tensor, Tensor, Tensor]]:
    """The update of an object after a random number of learned steps, and the inputs of the next one."""
    episode, theta = draw.episode, model.theta.detach()

    def inputs() -> tuple[Tensor, Tensor, Tensor]:
        return step_inputs(
            model, episode.prepared, theta + update, GRADIENT_RAYS, draw.generator, pixels=episode.support_live
        )

    for _ in range(int(torch.randint(MAX_LEARNED_STEPS, (), generator=draw.generator))):
        read = inputs()
        with torch.no_grad():
            update = update + {GRID_WEIGHT: fitted(*read)[0]}
    return update, inputs()
