"""Source of truth: properties. An untrained step is zero, and the scale of the gradient does not matter."""

import torch

from hyperplanes.hypernetwork import LearnedStep


def read(objects=2, *, side=8):
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(objects, channels, side, side, side, generator=generator) for channels in (1, 3, 3)]


def awake():
    """A learned step whose last layer is not zero."""
    step = LearnedStep(8, 3)
    torch.nn.init.normal_(step.network.last.weight, generator=torch.Generator().manual_seed(1))
    step.rates.fill_(0.1)
    return step


def test_an_untrained_step_is_zero_and_requires_no_gradient():
    step = LearnedStep(8, 3)
    assert not step(*read()).any()
    assert not any(value.requires_grad for value in step.parameters())


def test_the_step_depends_on_the_sign_of_the_gradient_and_not_on_its_scale():
    hull, grid, gradient = read()
    step = awake()
    found = step(hull, grid, gradient)
    torch.testing.assert_close(step(hull, grid, 1e-4 * gradient), found)
    assert (step(hull, grid, -gradient) - found).abs().max() > 0.1


def test_objects_of_a_batch_are_independent():
    step, values = awake(), read()
    together = step(*values)
    torch.testing.assert_close(step(*(each[1:] for each in values))[0], together[1], rtol=1e-4, atol=1e-5)


def test_with_rates_alone_the_step_is_against_the_gradient():
    hull, grid, gradient = read()
    step = LearnedStep(8, 3)
    step.rates.fill_(0.1)
    assert (step(hull, grid, gradient).sign() == -gradient.sign()).all()


def test_a_gradient_of_zero_gives_a_finite_step():
    hull, grid, gradient = read()
    assert torch.isfinite(awake()(hull, grid, 0 * gradient)).all()
