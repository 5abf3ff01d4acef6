"""Sources of truth: torch.optim's own steps, singular values of orthogonalised matrices, the minimum of a quadratic."""

from concurrent.futures import ThreadPoolExecutor
from threading import get_ident

import pytest
import torch

from hyperplanes.adaptation.optimisation.optimisers import Muon, make_optimisers, orthogonalise


@pytest.mark.parametrize("shape", [(40, 40), (60, 20), (20, 60)])
def test_an_orthogonalised_matrix_has_singular_values_near_one_and_the_same_vectors(shape):
    # Source of truth: the singular value decomposition, U V^T.
    torch.manual_seed(0)
    u, _, v = torch.linalg.svd(torch.randn(shape), full_matrices=False)
    matrix = u @ torch.diag(torch.linspace(0.3, 3.0, min(shape))) @ v
    result = orthogonalise(matrix)
    inner = u.mT @ result @ v.mT
    assert (inner - inner.diag().diag()).abs().max() < 1e-4
    assert 0.65 < inner.diag().min() < inner.diag().max() < 1.25


def test_steps_of_muon_agree_with_torch():
    # Another implementation: torch.optim.Muon, which iterates in bfloat16.
    if not hasattr(torch.optim, "Muon"):
        pytest.skip("this torch has no Muon to compare with")
    torch.manual_seed(0)
    ours, theirs = torch.randn(24, 40, requires_grad=True), torch.empty(24, 40, requires_grad=True)
    start = ours.detach().clone()
    theirs.data.copy_(start)
    pair = Muon([ours], 0.1), torch.optim.Muon([theirs], lr=0.1, momentum=0.95, weight_decay=0.0)
    for _ in range(5):
        ours.grad = torch.randn(24, 40)
        theirs.grad = ours.grad.clone()
        for optimiser in pair:
            optimiser.step()
    moved = (ours - start).norm()
    assert (ours - theirs).norm() < 0.05 * moved


@pytest.mark.parametrize(("device", "shared"), [("cpu", True), ("meta", False)])
def test_tensors_that_are_not_on_a_cpu_are_stepped_in_the_calling_thread(monkeypatch, device, shared):
    # Other threads have their own streams on a GPU, which do not wait for the gradients of this thread.
    seen = []
    monkeypatch.setattr(
        "hyperplanes.adaptation.optimisation.optimisers.orthogonalise", lambda value: seen.append(get_ident()) or value
    )
    monkeypatch.setattr("hyperplanes.adaptation.optimisation.optimisers.parallel_map", in_another_thread)
    values = [torch.zeros(4, 4, device=device, requires_grad=True) for _ in range(2)]
    for value in values:
        value.grad = torch.zeros_like(value)
    Muon(values, 0.1).step()
    assert len(seen) == 2
    assert (get_ident() not in seen) == shared


def in_another_thread(function, items):
    with ThreadPoolExecutor(1) as thread:
        return list(thread.map(function, items))


def test_a_quadratic_is_minimised():
    torch.manual_seed(0)
    goal, value = torch.randn(20, 30), torch.zeros(20, 30, requires_grad=True)
    optimiser = Muon([value], lr=0.3)
    for step in range(120):
        optimiser.param_groups[0]["lr"] = 0.3 * (1 - step / 120)
        optimiser.zero_grad()
        (value - goal).square().sum().backward()
        optimiser.step()
    assert (value - goal).norm() < 0.05 * goal.norm()


def test_matrices_of_hidden_layers_go_to_muon_and_the_rest_to_adam():
    hidden, head, bias = (torch.zeros(shape, requires_grad=True) for shape in ((32, 20), (3, 32), (32,)))
    adam, muon = make_optimisers([hidden, head, bias], "muon", 1e-3, 0.02)
    assert isinstance(adam, torch.optim.Adam)
    assert isinstance(muon, Muon)
    assert [id(value) for value in adam.param_groups[0]["params"]] == [id(head), id(bias)]
    assert [id(value) for value in muon.param_groups[0]["params"]] == [id(hidden)]
    (only,) = make_optimisers([hidden, head, bias], "adam", 1e-3, 0.02)
    assert isinstance(only, torch.optim.Adam)
    with pytest.raises(ValueError, match="parameters: expected matrices, got a tensor of another number of dimensions"):
        Muon([bias])
