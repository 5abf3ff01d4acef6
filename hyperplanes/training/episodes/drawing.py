"""Random draws of a training: the objects of each step, and the generators of everything random about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.geometry.rays import Sphere

__all__ = [
    "draw",
    "draw_balanced",
    "draw_episodes",
    "episode_generator",
    "episode_object",
    "object_generator",
    "points_in",
    "step_generator",
]

EPISODES, ORDERS = 1, 2  # parts of the seeds of these streams, which keep them different from those of rays

OBJECTS_A_STREAM = 4
"""Objects of a step that draw from one stream of episodes; further objects draw from other streams."""


def step_generator(seed: int, step: int) -> torch.Generator:
    """The generator of the objects of a step; steps begin at 0."""
    return torch.Generator().manual_seed(seed * 1_000_003 + step)


def object_generator(seed: int, step: int, place: int) -> torch.Generator:
    """The generator of rays and samples of one object of a step; it does not depend on the other objects.

    Args:
        seed: the seed of the training.
        step: the step, from 0.
        place: the index of the object in the step.
    """
    return _generator(seed, step, place)


def episode_generator(seed: int, number: int) -> torch.Generator:
    """The generator of the views of an episode; numbers begin at 0."""
    return _generator(seed, number, 0, EPISODES)


def draw(names: Sequence[str], count: int, generator: torch.Generator) -> list[str]:
    """The objects of a step. An object occurs twice only if there are fewer objects than `count`."""
    if count == 1:
        return [names[int(torch.randint(len(names), (), generator=generator))]]
    return [names[index] for index in _places(len(names), count, generator)]


def draw_balanced(classes: Mapping[str, Sequence[str]], count: int, generator: torch.Generator) -> list[str]:
    """The objects of a step, such that the numbers of objects of any two classes differ by at most one.

    Args:
        classes: the objects of each class.
        count: the number of objects to draw.
        generator: the generator of the draws.

    Returns:
        Names, in a random order of classes. A name occurs twice only if its class has too few objects.
    """
    known = sorted(classes)
    order = [known[index] for index in _places(len(known), count, generator)]
    drawn = {name: iter(draw(classes[name], order.count(name), generator)) for name in sorted(set(order))}
    return [next(drawn[name]) for name in order]


def draw_episodes(count: int, at_hand: int, step: int, generator: torch.Generator) -> list[int]:
    """The numbers of the episodes of a step, all different.

    Every four objects of a step draw from their own stream of episodes. So an episode is drawn equally often whatever
    the number of objects of a step, and processes that share the objects of a step also share the streams.

    Args:
        count: the number of episodes to draw.
        at_hand: the number of episodes of each stream to draw from; each step replaces the oldest one by a new one.
        step: steps done before.
        generator: the generator of the draws.

    Returns:
        The episodes of the first stream, then those of the next.
    """
    streams = max(1, count // OBJECTS_A_STREAM)
    drawn: list[int] = []
    for stream in range(streams):
        own = count * (stream + 1) // streams - count * stream // streams
        places = torch.randperm(max(at_hand, own), generator=generator)[:own]
        drawn += [(step + place) * streams + stream for place in places.tolist()]
    return drawn


def episode_object(classes: Mapping[str, Sequence[str]], number: int, seed: int) -> str:
    """The object of an episode. Classes alternate, and in each class all objects occur once before any is repeated.

    Args:
        classes: the objects of each class.
        number: the number of the episode, from 0.
        seed: the seed of the training.
    """
    turn, place = divmod(number, len(classes))
    chosen = sorted(classes)[place]
    epoch, index = divmod(turn, len(classes[chosen]))
    order = torch.randperm(len(classes[chosen]), generator=_generator(seed, epoch, place, ORDERS))
    return classes[chosen][int(order[index])]


def points_in(bounds: Sphere, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    """Uniformly random points in a sphere, on the CPU."""
    unit = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    unit = unit * torch.rand(count, 1, generator=generator) ** (1 / 3)
    return unit * bounds.radius + torch.tensor(bounds.centre)


def _generator(*numbers: int) -> torch.Generator:
    """A generator whose stream is independent of those of other numbers and of another count of numbers."""
    state = np.random.SeedSequence(numbers).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0]))


def _places(total: int, count: int, generator: torch.Generator) -> list[int]:
    repeats = -(-count // total)
    return torch.cat([torch.randperm(total, generator=generator) for _ in range(repeats)])[:count].tolist()
