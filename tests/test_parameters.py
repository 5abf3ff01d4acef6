"""Source of truth: sums of tensors by hand."""

import pytest
import torch
from torch import nn

from hyperplanes.parameters import Parameters


def network():
    return nn.ModuleDict({"fine": nn.Linear(2, 3), "coarse": nn.Linear(2, 3)})


def test_parameters_are_shared_with_their_module():
    module = network()
    theta = Parameters.of(module)
    assert set(theta) == {"fine.weight", "fine.bias", "coarse.weight", "coarse.bias"}
    assert theta["fine.bias"] is module["fine"].bias


def test_an_update_changes_only_the_tensors_that_it_names():
    theta = Parameters.of(network())
    before = theta["fine.bias"].clone()
    shifted = theta + {"fine.bias": torch.ones(3)}
    torch.testing.assert_close(shifted["fine.bias"], before + 1)
    assert torch.equal(theta["fine.bias"], before)
    assert shifted["fine.weight"] is theta["fine.weight"]
    assert isinstance(shifted, Parameters)


def test_empty_and_zero_updates_change_nothing():
    theta = Parameters.of(network())
    for update in ({}, {name: torch.zeros_like(value) for name, value in theta.items()}):
        assert all(torch.equal(value, theta[name]) for name, value in (theta + update).items())


def test_gradients_reach_both_terms():
    theta, update = torch.ones(2, requires_grad=True), torch.ones(2, requires_grad=True)
    (Parameters(w=theta) + {"w": update})["w"].square().sum().backward()
    assert theta.grad.tolist() == update.grad.tolist() == [4.0, 4.0]


def test_updates_of_other_names_or_shapes_are_refused():
    theta = Parameters.of(network())
    with pytest.raises(ValueError, match="update: expected names among .*, got 'medium.bias'"):
        theta + {"medium.bias": torch.ones(3)}
    with pytest.raises(ValueError, match=r"update of fine.bias: expected \(3,\), got \(1,\)"):
        theta + {"fine.bias": torch.ones(1)}  # it would be broadcast


def test_names_in_a_part_are_relative_to_the_part():
    theta = Parameters({"fine.colour.bias": torch.ones(1), "finer.colour.bias": torch.zeros(1), "fine": torch.zeros(1)})
    assert {name: value.item() for name, value in theta.under("fine").items()} == {"colour.bias": 1.0}


def test_detached_parameters_require_no_gradient():
    theta = Parameters.of(network()).detach()
    assert isinstance(theta, Parameters)
    assert not any(value.requires_grad for value in theta.values())
