"""Source of truth: gradient steps of a linear regression, computed by hand, and finite differences."""

from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import InitialisationConfig
from hyperplanes.adaptation.fine_tuned import shuffled
from hyperplanes.adaptation.optimisation.descent import ray_loss
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.parameters import Parameters
from hyperplanes.training.meta_gradients import maml_gradient, reptile_gradient
from tests.reference_rendering import ball_views, ring, small_model

X, Y, RATE = torch.tensor([1.0, 2.0, -1.0]), torch.tensor([3.0, 1.0, 0.5]), 0.1
QUERY_X, QUERY_Y = torch.tensor([0.5, -2.0]), torch.tensor([1.0, 1.0])


def squared_error(x, y):
    """Mean of (w x - y)^2, with derivative 2 mean(x (w x - y)) with respect to w."""
    return lambda parameters: (parameters["w"] * x - y).square().mean()


def slope(w, x, y):
    return 2 * (x * (w * x - y)).mean()


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_maml_on_a_line_through_zero(steps):
    # a step is w' = w - rate derivative(w), so that dw'/dw = 1 - 2 rate mean(x^2) at every step
    w = torch.tensor(0.7)
    after = w.clone()
    for _ in range(steps):
        after = after - RATE * slope(after, X, Y)
    inner, outer = [squared_error(X, Y)] * steps, squared_error(QUERY_X, QUERY_Y)
    second, loss = maml_gradient({"w": w}, inner, outer, RATE)
    first, same_loss = maml_gradient({"w": w}, inner, outer, RATE, first_order=True)
    torch.testing.assert_close(loss, (after * QUERY_X - QUERY_Y).square().mean())
    assert loss == same_loss
    torch.testing.assert_close(first["w"], slope(after, QUERY_X, QUERY_Y))
    factor = (1 - 2 * RATE * X.square().mean()) ** steps
    torch.testing.assert_close(second["w"], slope(after, QUERY_X, QUERY_Y) * factor)


def test_reptile_on_a_line_through_zero():
    # K steps multiply w - w* by (1 - 2 rate mean(x^2))^K, with w* = mean(x y) / mean(x^2); then the mean of two objects
    w, adapted, expected = torch.tensor(0.7), [], []
    for x, y in ((X, Y), (QUERY_X, QUERY_Y)):
        here = w.clone()
        for _ in range(5):
            here = here - RATE * slope(here, x, y)
        best = (x * y).mean() / x.square().mean()
        adapted.append({"w": here})
        expected.append((w - best) * (1 - (1 - 2 * RATE * x.square().mean()) ** 5))
    torch.testing.assert_close(reptile_gradient({"w": w}, adapted)["w"], torch.stack(expected).mean())


@pytest.mark.parametrize("target", ["nerf", "point_multiplane"])
def test_the_gradient_of_maml_through_a_renderer_is_that_of_finite_differences(target):
    model = small_model(hypernetwork=None, target=target).double()
    prepared = model.prepare(ball_views(ring(4)))
    generator = torch.Generator().manual_seed(0)
    batches = [prepared.views.sample_rays(24, generator=generator) for _ in range(3)]

    def loss_of(rays, truth):
        return lambda parameters: ray_loss(model.field(prepared, parameters).trace(rays), truth)

    losses = [loss_of(*batch) for batch in batches]
    theta = model.theta.detach()
    along = Parameters((name, torch.randn(value.shape, generator=generator).double()) for name, value in theta.items())
    gradient, _ = maml_gradient(theta, losses[:2], losses[2], 0.2)
    plain, _ = maml_gradient(theta, losses[:2], losses[2], 0.2, first_order=True)

    def outer(step):
        moved = Parameters((name, value + step * along[name]) for name, value in theta.items())
        return maml_gradient(moved, losses[:2], losses[2], 0.2, first_order=True)[1]

    expected = (outer(1e-6) - outer(-1e-6)) / 2e-6
    found, without = (sum((each[name] * along[name]).sum() for name in along) for each in (gradient, plain))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-8)
    assert not torch.isclose(without, expected, rtol=1e-3)


def test_shuffled_weights_are_a_permutation():
    model = small_model(hypernetwork=None)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    one, again, other = shuffled(model), shuffled(model), shuffled(model, seed=1)
    for name, value in model.networks.named_parameters():
        assert torch.equal(value, before[f"networks.{name}"])
        mixed = one.networks.get_parameter(name)
        assert torch.equal(mixed.flatten().sort().values, value.flatten().sort().values)
        assert torch.equal(mixed, again.networks.get_parameter(name))
        if len(value.flatten().unique()) > 10:
            assert not torch.equal(mixed, value)
            assert not torch.equal(mixed, other.networks.get_parameter(name))


def test_descent_is_plain_with_a_constant_rate_by_default():
    config = InitialisationConfig(inner_rate=0.3, test_rays=17)
    settings = config.descent()
    assert (settings.optimiser, settings.learning_rate, settings.rays, settings.trainable) == (
        "sgd",
        0.3,
        17,
        "weights",
    )
    assert settings.schedule(0, 10) == settings.schedule(9, 10) == 1
    given = FineTuning(learning_rate=1e-3, final_rate_factor=0.2, seed=4)
    told = config.descent(5, given=given)
    assert (told.optimiser, told.learning_rate, told.rays, told.seed) == ("sgd", 1e-3, 5, 4)
    assert told.schedule(9, 10) == told.final_rate_factor == 1
    told = config.descent(5, given=replace(given, optimiser="adam"))
    assert (told.optimiser, told.learning_rate, told.rays, told.seed) == ("adam", 1e-3, 5, 4)
    assert told.final_rate_factor == 0.2
    with pytest.raises(ValueError, match="method: expected one of mv_meta, .*, got 'reptile'"):
        InitialisationConfig(method="reptile")
