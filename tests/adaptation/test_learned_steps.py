"""Sources of truth: finite differences of the loss, and cases in which there are no learned steps."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.network import GRID_WEIGHT
from hyperplanes.adaptation.optimisation import learned_steps
from hyperplanes.adaptation.optimisation.learned_steps import PARTS, grid_gradient, take_learned_steps, updated_weights
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.training import learned_step as training
from hyperplanes.training.learned_step import fit_learned_step
from tests.adaptation.test_stacking import CONFIG, model
from tests.reference_rendering import Balls, ball_views, ring

pytestmark = pytest.mark.usefixtures("all_rays")


def stepping(steps=1):
    """A model whose learned steps are steps of gradient descent."""
    made = HyperPlanes(replace(CONFIG, stacked=False, learned_steps=steps))
    made.load_state_dict(model().state_dict(), strict=False)
    made.learned_step.rates.fill_(1.0)
    return made.eval()


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def error_and_gradient(adapter, context, weights, rays, seed=0):
    """The error and its gradient."""
    errors, find = [], learned_steps.summed_gradients

    def kept(*inputs, **options):
        error, gradients = find(*inputs, **options)
        errors.append(float(error))
        return error, gradients

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_steps, "summed_gradients", kept)
        gradient = grid_gradient(adapter, context, weights, rays, generator(seed))
    return errors[0], gradient


def test_the_gradient_agrees_with_finite_differences():
    adapter = stepping().double()
    context = adapter.prepare(ball_views(ring(5)))
    weights = adapter.adapted_weights(context)
    error, gradient = error_and_gradient(adapter, context, weights, 512)
    assert gradient.shape == weights[GRID_WEIGHT].shape
    change = gradient / gradient.norm()
    ahead, behind = (
        error_and_gradient(adapter, context, weights + {GRID_WEIGHT: step * change}, 512)[0] for step in (1e-3, -1e-3)
    )
    assert (ahead - behind) / 2e-3 == pytest.approx(float(gradient.norm()), rel=1e-3)
    assert error > 0


def test_rays_come_from_masked_views(monkeypatch):
    masked, adapter = [], stepping()
    context = adapter.prepare(ball_views(ring(13)))
    kind = type(context)
    own = kind.mask_views
    monkeypatch.setattr(kind, "mask_views", lambda self, views: masked.append(views.tolist()) or own(self, views))
    grid_gradient(adapter, context, adapter.adapted_weights(context), 64, generator())
    assert sorted(len(each) for each in masked) == [2] * PARTS
    assert len(set(sum(masked, []))) == 2 * PARTS


def test_every_view_is_masked_once_before_any_is_again():
    for count in (2, 3, 5, 40):
        parts = learned_steps._masked(count, generator(count))
        times = torch.bincount(torch.cat(parts), minlength=count)
        assert len(parts) == PARTS
        assert int(times.max() - times.min()) <= 1


def test_steps_lower_the_error_and_are_the_same_each_time():
    adapter, support = stepping(3), ball_views(ring(6))
    context = adapter.prepare(support)
    first, second = (updated_weights(adapter, context) for _ in range(2))
    errors = [
        error_and_gradient(adapter, context, weights, 4096, seed=9)[0]
        for weights in (adapter.adapted_weights(context), first)
    ]
    assert errors[1] < errors[0] - 1e-5
    assert torch.equal(first[GRID_WEIGHT], second[GRID_WEIGHT])


@pytest.mark.parametrize(("views", "expected"), [(2, 5), (19, 5), (20, 3), (22, 3)])
def test_with_many_views_half_as_many_steps_are_taken(views, expected, monkeypatch):
    taken, adapter = [], stepping(5)
    context = adapter.prepare(ball_views(ring(views)))

    def no_gradient(adapter, context, weights, *drawn, **options):
        taken.append(1)
        return torch.zeros_like(weights[GRID_WEIGHT])

    monkeypatch.setattr(learned_steps, "grid_gradient", no_gradient)
    updated_weights(adapter, context)
    assert len(taken) == expected


def changed(adapter, support, **options):
    """Whether learned steps change the weights of an object."""
    context = adapter.prepare(support, **options)
    return not torch.equal(
        updated_weights(adapter, context)[GRID_WEIGHT], adapter.adapted_weights(context)[GRID_WEIGHT]
    )


def test_there_are_no_learned_steps_for_a_single_view_or_without_masks():
    views, plane = ball_views(ring(3)), Symmetry(Plane((1.0, 0.0, 0.0)))
    assert changed(stepping(), views)
    assert changed(stepping(), views, symmetry=plane)
    assert not changed(stepping(), views[:1])
    assert not changed(stepping(), views[:1], symmetry=plane)
    assert not changed(stepping(), ball_views(ring(3), masks=False))
    assert not changed(model(), views)


def test_learned_steps_work_in_inference_mode():
    adapter, support = stepping(), ball_views(ring(4))
    plain = adapter.adapt(support).render(support.cameras).images
    with torch.inference_mode():
        made = adapter.adapt(ball_views(ring(4))).render(support.cameras).images
    assert torch.equal(plain, made)


def test_learned_steps_are_saved_in_a_checkpoint(tmp_path):
    adapter, support = stepping(), ball_views(ring(3))
    adapter.save(tmp_path)
    found = HyperPlanes.from_pretrained(tmp_path)
    assert torch.equal(
        found.adapt(support).field.parameters["grid.weight"], adapter.adapt(support).field.parameters["grid.weight"]
    )


def test_the_weights_of_one_object_take_no_learned_steps():
    adapter, support = stepping(), ball_views(ring(3))
    adapted = adapter.adapt(support)
    alone = adapter.with_weights_of(adapted)
    assert not alone.config.learned_steps
    torch.testing.assert_close(
        alone.adapt(support).render(support.cameras).images, adapted.render(support.cameras).images
    )


def test_learned_steps_without_a_grid_are_refused():
    with pytest.raises(ValueError, match="learned_steps: expected 0 without a hypernetwork of kind 'volume', got 2"):
        HyperPlanes(replace(CONFIG, hypernetwork=None, learned_steps=2))


def test_a_swapped_update_is_followed_by_learned_steps():
    adapter, views = stepping(), [ball_views(ring(4)), ball_views(ring(4), colour=(0.1, 0.3, 0.9), radius=0.4)]
    context = adapter.prepare(views[0])
    foreign = adapter.theta + adapter.update(adapter.prepare(views[1]))
    expected = take_learned_steps(adapter, context, foreign)[GRID_WEIGHT]
    assert not torch.equal(expected, foreign[GRID_WEIGHT])
    swapped = Swapped(adapter, views)
    torch.testing.assert_close(swapped.adapt(views[0]).field.parameters["grid.weight"], expected)
    with torch.inference_mode():  # steps need gradients
        torch.testing.assert_close(swapped.adapt(views[0]).field.parameters["grid.weight"], expected)


def test_training_gives_a_step_that_improves_query_views_and_does_not_change_the_model(monkeypatch):
    adapter, data = stepping(1), Balls(views=6)
    config = TrainingConfig(steps=8, tasks=1, rays=64, views=(2, 3, 4), held_out=0)
    before, done = {name: value.clone() for name, value in adapter.state_dict().items()}, []
    with monkeypatch.context() as patch:
        patch.setattr(training, "WARMUP", 1)
        patch.setattr(training, "MAX_LEARNED_STEPS", 2)
        patch.setattr(training, "GRADIENT_RAYS", 128)
        patch.setattr(learned_steps, "PARTS", 1)
        fitted = fit_learned_step(adapter, data, config, on_step=lambda step, loss: done.append(step))
    assert done == list(range(1, 9))
    assert not any(value.requires_grad for value in fitted.parameters())
    assert all(torch.equal(value, before[name]) for name, value in adapter.state_dict().items())
    # evaluated on a held-out object
    task, errors = data.task("test0"), []
    for steps in (0, 1):
        adapter.learned_step, adapter.config = fitted, replace(adapter.config, learned_steps=steps)
        pictures = adapter.adapt(task.support[:3]).render(task.query.cameras).images
        errors.append(float((pictures - task.query.images).square().mean()))
    assert errors[1] < errors[0] - 4e-5  # measured: 5.6e-5, and 7e-7 with an untrained step


def test_training_starts_from_the_step_of_the_model(monkeypatch):
    monkeypatch.setattr(training, "RATE", 0.0)
    adapter = stepping(1)
    config = TrainingConfig(steps=1, tasks=2, rays=64, views=(2, 3), held_out=0)
    fitted = fit_learned_step(adapter, Balls(views=6), config)
    for name, value in adapter.learned_step.state_dict().items():
        assert torch.equal(fitted.state_dict()[name], value)
    assert fitted is not adapter.learned_step


def test_training_covers_the_first_four_steps(monkeypatch):
    """The trained step comes after none, one, two or three others."""
    followed, adapter = [], stepping(1)
    read = (None, None, torch.zeros_like(adapter.theta[GRID_WEIGHT])[None])
    monkeypatch.setattr(training, "step_inputs", lambda *inputs, **options: followed.append(1) or read)
    draw = SimpleNamespace(episode=SimpleNamespace(prepared=None, support_live=None), generator=generator())
    counts = set()
    for _ in range(12):
        followed.clear()
        _, inputs = training._after_others(adapter, lambda *read: read[2], draw, adapter.theta.detach())
        counts.add(len(followed))
        assert inputs is read
    assert counts == {1, 2, 3, 4}
