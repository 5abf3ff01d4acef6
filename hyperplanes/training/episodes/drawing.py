"""Which objects a step is of, and what everything random about each is drawn from."""

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

EPISODES, ORDERS = 1, 2  # set the streams of these apart from those of rays

OBJECTS_A_STREAM = 4
"""Objects of a step that share the episodes at hand; further ones have others."""


def step_generator(seed: int, step: int) -> torch.Generator:
    """What the objects of a step (the first is 0) are drawn from."""
    return torch.Generator().manual_seed(seed * 1_000_003 + step)


def object_generator(seed: int, step: int, place: int) -> torch.Generator:
    """What rays and samples of the object at a place of a step are drawn from, whoever else is in it."""
    return _generator(seed, step, place)


def episode_generator(seed: int, number: int) -> torch.Generator:
    """What the views of an episode are drawn from; numbers begin at 0."""
    return _generator(seed, number, 0, EPISODES)


def draw(names: Sequence[str], count: int, generator: torch.Generator) -> list[str]:
    """Objects of a step, different ones while there are enough."""
    if count == 1:
        return [names[int(torch.randint(len(names), (), generator=generator))]]
    return [names[index] for index in _places(len(names), count, generator)]


def draw_balanced(classes: Mapping[str, Sequence[str]], count: int, generator: torch.Generator) -> list[str]:
    """Objects of a step in which the numbers of objects of any two classes differ by at most one.

    Args:
        classes: the objects of each.
        count: how many.
        generator: of the draws.

    Returns:
        Names, in an order of classes that is drawn too; different ones while a class has enough.
    """
    known = sorted(classes)
    order = [known[index] for index in _places(len(known), count, generator)]
    drawn = {name: iter(draw(classes[name], order.count(name), generator)) for name in sorted(set(order))}
    return [next(drawn[name]) for name in order]


def draw_episodes(count: int, at_hand: int, step: int, generator: torch.Generator) -> list[int]:
    """Numbers of the episodes of a step, different ones.

    Every four objects of a step draw from a stream of episodes of their own, so that an episode is drawn as often
    however many objects a step has, and processes that share the objects of a step share the streams.

    Args:
        count: how many.
        at_hand: episodes of each stream that there are at a time; every step begins one more.
        step: steps done before.
        generator: of the draws.

    Returns:
        Those of the first stream, then those of the next.
    """
    streams = max(1, count // OBJECTS_A_STREAM)
    drawn: list[int] = []
    for stream in range(streams):
        own = count * (stream + 1) // streams - count * stream // streams
        places = torch.randperm(max(at_hand, own), generator=generator)[:own]
        drawn += [(step + place) * streams + stream for place in places.tolist()]
    return drawn


def episode_object(classes: Mapping[str, Sequence[str]], number: int, seed: int) -> str:
    """The object of an episode: classes in turn, and within each all objects once before any comes again.

    Args:
        classes: the objects of each.
        number: of the episode, from 0.
        seed: of the training.
    """
    turn, place = divmod(number, len(classes))
    chosen = sorted(classes)[place]
    epoch, index = divmod(turn, len(classes[chosen]))
    order = torch.randperm(len(classes[chosen]), generator=_generator(seed, epoch, place, ORDERS))
    return classes[chosen][int(order[index])]


def points_in(bounds: Sphere, count: int, generator: torch.Generator) -> Float[Tensor, "point 3"]:
    """Random points, evenly in the volume of a sphere, on the CPU."""
    unit = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    unit = unit * torch.rand(count, 1, generator=generator) ** (1 / 3)
    return unit * bounds.radius + torch.tensor(bounds.centre)


def _generator(*numbers: int) -> torch.Generator:
    """A generator whose stream has nothing to do with that of other numbers, or of another count of them."""
    state = np.random.SeedSequence(numbers).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0]))


def _places(total: int, count: int, generator: torch.Generator) -> list[int]:
    repeats = -(-count // total)
    return torch.cat([torch.randperm(total, generator=generator) for _ in range(repeats)])[:count].tolist()
