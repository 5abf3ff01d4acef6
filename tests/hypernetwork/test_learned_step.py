"""Source of truth: a step that is not trained is none, and only the direction of a gradient counts."""

import torch

from hyperplanes.hypernetwork import LearnedStep


def read(objects=2, *, side=8):
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(objects, channels, side, side, side, generator=generator) for channels in (1, 3, 3)]


def awake():
    """A step whose last layer is not zero."""
    step = LearnedStep(8, 3)
    torch.nn.init.normal_(step.network.last.weight, generator=torch.Generator().manual_seed(1))
    step.rates.fill_(0.1)
    return step


def test_a_step_that_is_not_trained_is_none_and_has_no_gradient():
    step = LearnedStep(8, 3)
    assert not step(*read()).any()
    assert not any(value.requires_grad for value in step.parameters())


def test_the_scale_of_a_gradient_changes_nothing_and_its_sign_does():
    hull, grid, gradient = read()
    step = awake()
    found = step(hull, grid, gradient)
    torch.testing.assert_close(step(hull, grid, 1e-4 * gradient), found)
    assert (step(hull, grid, -gradient) - found).abs().max() > 0.1


def test_objects_do_not_see_each_other():
    step, values = awake(), read()
    together = step(*values)
    torch.testing.assert_close(step(*(each[1:] for each in values))[0], together[1], rtol=1e-4, atol=1e-5)


def test_rates_alone_go_against_the_gradient():
    hull, grid, gradient = read()
    step = LearnedStep(8, 3)
    step.rates.fill_(0.1)
    assert (step(hull, grid, gradient).sign() == -gradient.sign()).all()


def test_an_object_that_no_ray_meets_is_left_in_peace():
    hull, grid, gradient = read()
    assert torch.isfinite(awake()(hull, grid, 0 * gradient)).all()
