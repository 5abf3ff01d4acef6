"""Cached values that are computed from tensors must be those of the current tensors."""

import gc
import weakref
from types import SimpleNamespace

import torch

from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.utilities.tensors.cached_on import cached_on


def test_a_value_is_computed_again_after_an_in_place_change_or_for_another_tensor():
    owner, made = SimpleNamespace(), []

    def asked(*tensors):
        return cached_on(owner, "sum", tensors, lambda: made.append(0) or float(sum(each.sum() for each in tensors)))

    one, other = torch.ones(3), torch.zeros(2)
    assert asked(one, other) == asked(one, other) == 3.0
    assert len(made) == 1
    other += 1
    assert asked(one, other) == asked(one, other) == 5.0
    assert asked(one.clone(), other) == 5.0
    assert len(made) == 3


def test_the_tensors_of_a_cached_value_are_kept_alive():
    owner, value = SimpleNamespace(), torch.ones(1000)
    cached_on(owner, "sum", [value], lambda: 0)
    alive = weakref.ref(value)
    del value
    gc.collect()
    assert alive() is not None


def test_values_inside_function_transforms_are_not_cached():
    owner = SimpleNamespace()

    def squared(value):
        return cached_on(owner, "square", [value], lambda: value.square().sum())

    for point in (torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])):
        assert torch.equal(torch.func.grad(squared)(point), 2 * point)
    assert float(squared(torch.ones(2))) == 2.0


def test_a_compiled_graph_uses_a_value_that_was_cached_before():
    grid = full(Sphere(), 4)
    expected = grid.box[0]
    times = torch.compile(lambda value: value * grid.box[0], backend="eager", fullgraph=True)
    assert torch.equal(times(torch.ones(2)), torch.full((2,), expected))
