import pytest
import torch

from hyperplanes.adaptation.fine_tuning import FineTuned
from hyperplanes.metrics import psnr
from hyperplanes.rendering import Hierarchical
from tests.reference_rendering import awaken, ball_views, ring, small_model


@pytest.fixture
def model():
    return awaken(small_model())


@pytest.fixture
def support():
    return ball_views(ring(4))


def test_the_model_stays_as_it_is_bit_for_bit(model, support):
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model.fine_tune(support, 3, rays=64)
    after = model.state_dict()
    assert set(after) == set(before)
    assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_no_gradient_is_left_in_the_model(model, support):
    model.fine_tune(support, 1, rays=64)
    assert all(value.grad is None for value in model.parameters())


def test_theta_is_frozen_and_only_the_updated_layers_move(model, support):
    fields = [model.fine_tune(support, steps, rays=64, learning_rate=1e-2).field for steps in (0, 4)]
    for name, value in model.theta.under("fine").items():
        first, last = fields[0].parameters[name], fields[1].parameters[name]
        if name.split(".")[0] in ("colour", "density"):
            assert not torch.equal(first, last)
        else:
            assert torch.equal(first, value)
            assert torch.equal(last, value)
        assert not last.requires_grad


def test_no_steps_are_adapting(model, support):
    cameras = ring(1, shift=1)
    assert torch.equal(model.fine_tune(support, 0).render(cameras).images, model.adapt(support).render(cameras).images)


def test_more_steps_fit_the_support_views_better(model, support):
    quality = [
        psnr(tuned.render(support.cameras).images, support.images).mean()
        for tuned in (model.fine_tune(support, steps, rays=128, learning_rate=1e-2) for steps in (0, 15))
    ]
    assert quality[1] > quality[0] + 1


def test_the_seed_decides(model, support):
    def picture(seed):
        return model.fine_tune(support, 3, rays=32, seed=seed, learning_rate=1e-2).render(ring(1)).images

    before = torch.random.get_rng_state()
    assert torch.equal(picture(1), picture(1))
    assert not torch.equal(picture(1), picture(2))
    assert torch.equal(before, torch.random.get_rng_state())


def test_it_works_where_gradients_are_switched_off(model, support):
    with torch.no_grad():
        tuned = model.fine_tune(support, 2, rays=32, learning_rate=1e-2)
    assert not torch.equal(tuned.render(ring(1)).images, model.adapt(support).render(ring(1)).images)


def test_the_coarse_network_is_fine_tuned_beside_the_fine_one(support):
    # the outputs of this hypernetwork are zero: only a loss of the coarse picture can move the coarse weights
    both = small_model(coarse_network=True, sampling=Hierarchical(6, 6))
    tuned = both.fine_tune(support, 1, rays=64, learning_rate=1e-2)
    for part, field in (("fine", tuned.field), ("coarse", tuned.proposal)):
        theta = both.theta.under(part)
        moved = {name for name, value in field.parameters.items() if not torch.equal(value, theta[name])}
        assert moved == {"colour.weight", "colour.bias", "density.weight", "density.bias"}


def test_a_model_without_a_hypernetwork_has_nothing_to_tune(support):
    with pytest.raises(ValueError, match="fine_tune: expected a model with a hypernetwork, got one without"):
        small_model(hypernetwork=None).fine_tune(support, 1)


def test_as_a_method_it_takes_its_steps_on_every_object(model, support):
    cameras = ring(1, shift=1)
    tuned = FineTuned(model, 2).adapt(support).render(cameras).images
    assert torch.equal(tuned, model.fine_tune(support, 2).render(cameras).images)
