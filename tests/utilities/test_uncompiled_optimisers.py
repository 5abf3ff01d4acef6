"""Optimisers that do not import the compiler, compared with those of torch.optim, which they subclass."""

from __future__ import annotations

import sys

import pytest
import torch
from torch import Tensor

from hyperplanes.adaptation.optimisation.optimisers import make_optimisers
from hyperplanes.utilities.tensors.uncompiled_optimisers import SGD, Adam


def descend(make, **options) -> tuple[list[Tensor], dict]:
    """Weights after five steps on a sum of squares with decreasing rates, and the state of the optimiser."""
    weights = [torch.linspace(-1, 1, 12).reshape(4, 3).requires_grad_(), torch.ones(5, requires_grad=True)]
    optimiser = make(weights, lr=0.1, **options)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.9)
    for _ in range(5):
        optimiser.zero_grad(set_to_none=True)
        torch.stack([each.square().sum() for each in weights]).sum().backward()
        optimiser.step()
        schedule.step()
    return weights, optimiser.state_dict()


@pytest.mark.parametrize(
    ("ours", "theirs", "options"),
    [(Adam, torch.optim.Adam, {"betas": (0.9, 0.99), "fused": True}), (SGD, torch.optim.SGD, {})],
)
def test_steps_agree_with_torch(ours, theirs, options):
    found, state = descend(ours, **options)
    expected, expected_state = descend(theirs, **options)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    assert all(each.requires_grad for each in found)
    assert state["param_groups"] == expected_state["param_groups"]
    assert state["state"].keys() == expected_state["state"].keys()
    for index, values in expected_state["state"].items():
        assert state["state"][index].keys() == values.keys()
        for name, value in values.items():
            own = state["state"][index][name]
            assert own is None if value is None else torch.equal(own, value), name


def test_optimisers_do_not_import_the_compiler(monkeypatch: pytest.MonkeyPatch):
    """The import takes longer than most optimisations."""
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # importing it raises
    for name in ("adam", "muon", "sgd"):
        weights = [torch.ones(20, 20, requires_grad=True), torch.ones(3, requires_grad=True)]
        for optimiser in make_optimisers(weights, name, 0.1, 0.1):
            optimiser.zero_grad()
            torch.stack([each.sum() for each in weights]).sum().backward()
            optimiser.step()
            optimiser.load_state_dict(optimiser.state_dict())
        assert all(float(each.detach().max()) < 1 for each in weights)
