"""The training of learned steps of gradient descent, after that of the model that they follow."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.optim import Adam

from hyperplanes.adaptation.gradients import summed_gradients
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.learned_steps import step_inputs
from hyperplanes.adaptation.network import GRID, HyperPlanesNetwork, in_use
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.hypernetwork import LearnedStep
from hyperplanes.parameters import Parameters
from hyperplanes.training.distributed import Processes
from hyperplanes.training.episodes import Draw, EpisodeLoader
from hyperplanes.training.forward import forward
from hyperplanes.training.losses import photometric_loss
from hyperplanes.utilities.seeding import seeded
from hyperplanes.views import Tasks

__all__ = ["fit_learned_step"]

RAYS = 1024  # of the views shown, from which a gradient is found
STEPS = 4  # the step that is trained is the first of an object, or follows one, two or three others
RATE, WARMUP, LAST = 1e-3, 100, 0.02  # of Adam at first, steps until then, and what share of it remains in the end


def fit_learned_step(
    model: HyperPlanes, data: Tasks, config: TrainingConfig, *, on_step: Callable[[int, float], None] | None = None
) -> LearnedStep:
    """Train learned steps of a model, whose own weights stay as they are.

    The loss is the squared error of query rays after a step. Of each object drawn, that step is one of the first STEPS.

    Args:
        model: with a hypernetwork that reads a volume. The training goes on from the learned step that it has, if any.
        data: the objects that it was trained on, or others.
        config: of the episodes, rays and number of the steps; rates and optimisers are those of this module.
        on_step: called with the number of steps done and the loss of the last one.

    Returns:
        The network: the `learned_step` of the model, whose configuration then says how many it takes.
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
    """Set the gradients of the network for the objects of a step; returns the mean loss."""
    with torch.no_grad():
        updates = model.updates([draw.episode.prepared for draw in draws])
    started = [_after_others(model, fitted, draw, update) for draw, update in zip(draws, updates, strict=True)]
    with torch.enable_grad():
        written = fitted(*(torch.cat(each) for each in zip(*(inputs for _, inputs in started), strict=True)))
    change = written.detach().requires_grad_()

    def loss(place: int) -> Tensor:
        update = started[place][0] + {GRID: change[place]}
        return photometric_loss(forward(model, draws[place], update, config)) / len(draws)

    total, (found,) = summed_gradients(loss, len(draws), [change])
    fitted.zero_grad()
    written.backward(found)
    return float(total)


def _after_others(
    model: HyperPlanes, fitted: LearnedStep, draw: Draw, update: Parameters
) -> tuple[Parameters, tuple[Tensor, Tensor, Tensor]]:
    """The update of an object after a random number of learned steps, and what the next of them reads."""
    episode, theta = draw.episode, model.theta.detach()

    def inputs() -> tuple[Tensor, Tensor, Tensor]:
        return step_inputs(model, episode.prepared, theta + update, RAYS, draw.generator, pixels=episode.support_live)

    for _ in range(int(torch.randint(STEPS, (), generator=draw.generator))):
        read = inputs()
        with torch.no_grad():
            update = update + {GRID: fitted(*read)[0]}
    return update, inputs()
