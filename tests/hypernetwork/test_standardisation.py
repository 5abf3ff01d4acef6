"""Sources of truth: mean and variance of the inputs, and the gradient of PyTorch's batch normalisation."""

import pytest
import torch

from hyperplanes.hypernetwork.images import standardisation
from hyperplanes.hypernetwork.images.standardisation import EPSILON, RunningStandardisation


def test_the_statistics_converge_to_those_of_the_inputs(monkeypatch):
    # Statistics: codes with known mean and variance, 4 objects per step.
    generator = torch.Generator().manual_seed(0)
    mean, deviation = torch.tensor([5.0, -3.0]), torch.tensor([0.1, 4.0])
    monkeypatch.setattr(standardisation, "MOMENTUM", 0.01)
    layer = RunningStandardisation((2,))
    for _ in range(2000):
        layer(mean + deviation * torch.randn(4, 2, generator=generator))
    torch.testing.assert_close(layer.mean, mean, atol=0.3, rtol=0.05)
    torch.testing.assert_close(layer.variance.sqrt(), deviation, rtol=0.1, atol=0)
    layer.eval()
    codes = layer(mean + deviation * torch.randn(10_000, 2, generator=generator))
    assert codes.mean(0).abs().max() < 0.15
    assert (codes.std(0) - 1).abs().max() < 0.1


def test_the_first_steps_are_averaged_evenly():
    layer = RunningStandardisation((1,))
    for value in (1.0, 2.0, 6.0):
        layer(torch.tensor([[value]]))
    assert layer.mean.item() == pytest.approx(3.0)


def test_the_variance_of_single_objects_is_that_of_the_objects():
    """Not the initial variance, which is 10,000 times as large."""
    generator, layer = torch.Generator().manual_seed(0), RunningStandardisation((2,))
    for _ in range(40):
        layer(0.01 * torch.randn(1, 2, generator=generator))
    assert (layer.variance.sqrt() / 0.01).sub(1).abs().max() < 0.5


def test_one_object_per_step_gives_finite_values():
    layer = RunningStandardisation((3,))
    assert layer(torch.ones(1, 3)).isfinite().all()
    assert layer(2 * torch.ones(1, 3)).isfinite().all()


def test_evaluation_does_not_change_the_statistics():
    layer = RunningStandardisation((3,))
    layer(torch.randn(4, 3))
    layer.eval()
    before = {name: value.clone() for name, value in layer.state_dict().items()}
    layer(torch.randn(4, 3) + 7)
    assert all(torch.equal(value, layer.state_dict()[name]) for name, value in before.items())


def test_training_and_evaluation_give_the_same_values():
    layer = RunningStandardisation((3,))
    for _ in range(5):
        layer(torch.randn(4, 3) + 2)
    codes = torch.randn(4, 3)
    training = layer(codes)  # with statistics that include this step
    torch.testing.assert_close(training, layer.eval()(codes))


def test_the_gradient_is_that_of_batch_normalisation_scaled_to_the_running_deviation():
    # Another implementation: PyTorch's batch norm, whose gradient has no component that all objects share.
    layer = RunningStandardisation((2,))
    for _ in range(5):
        layer(3 * torch.randn(4, 2))
    codes, weight = torch.randn(4, 2, requires_grad=True), torch.randn(4, 2)
    (layer(codes) * weight).sum().backward()
    other = codes.detach().clone().requires_grad_()
    normalised = torch.nn.functional.batch_norm(other, None, None, training=True, eps=EPSILON)
    ratio = ((codes.var(0, unbiased=False) + EPSILON) / (layer.variance + EPSILON)).sqrt().detach()
    (normalised * ratio * weight).sum().backward()
    torch.testing.assert_close(codes.grad, other.grad)
    assert codes.grad.sum(0).abs().max() < 1e-5
