"""Source of truth: a step that is not trained is none, and only the direction of a gradient counts."""

import torch

from hyperplanes.hypernetwork import LearnedStep


def read(objects=2, *, side=8):
    generator = torch.Generator().manual_seed(0)
    shapes = [(objects, 5, side, side, side), *[(objects, 3, side, side, side)] * 2]
    return [torch.randn(shape, generator=generator) for shape in shapes] + [torch.tensor([0.01, 0.2])[:objects]]


def awake():
    """A step whose last layer is not zero."""
    step = LearnedStep(5, 8, 3)
    torch.nn.init.normal_(step.network.last.weight, generator=torch.Generator().manual_seed(1))
    step.rates.fill_(0.1)
    return step


def test_a_step_that_is_not_trained_is_none_and_has_no_gradient():
    step = LearnedStep(5, 8, 3)
    assert not step(*read()).any()
    assert not any(value.requires_grad for value in step.parameters())


def test_the_scale_of_a_gradient_changes_nothing_and_its_sign_does():
    volume, grid, gradient, error = read()
    step = awake()
    found = step(volume, grid, gradient, error)
    torch.testing.assert_close(step(volume, grid, 1e-4 * gradient, error), found)
    assert (step(volume, grid, -gradient, error) - found).abs().max() > 0.1


def test_objects_do_not_see_each_other():
    step, values = awake(), read()
    together = step(*values)
    torch.testing.assert_close(step(*(each[1:] for each in values))[0], together[1], rtol=1e-4, atol=1e-5)


def test_rates_alone_go_against_the_gradient():
    volume, grid, gradient, error = read()
    step = LearnedStep(5, 8, 3)
    step.rates.fill_(0.1)
    assert (step(volume, grid, gradient, error).sign() == -gradient.sign()).all()


def test_an_object_that_no_ray_meets_is_left_in_peace():
    volume, grid, gradient, error = read()
    assert torch.isfinite(awake()(volume, grid, 0 * gradient, 0 * error)).all()
