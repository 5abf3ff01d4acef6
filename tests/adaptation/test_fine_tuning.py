"""Sources of truth: properties of gradient descent (frozen weights do not change by a bit, zero steps are adapting, the
seed determines the result), and a loss that decreases on the support views.
"""

import threading
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool2d

from hyperplanes.adaptation import AdaptedField, fine_tuning
from hyperplanes.adaptation.fine_tuned import FineTuned, FromScratch
from hyperplanes.adaptation.fine_tuning import make_descent
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.optimisation import descent as descent_module
from hyperplanes.adaptation.optimisation.descent import contrast, draw_pixels, ray_loss, split_holdout
from hyperplanes.configuration.fine_tuning import FINE_VIEWS, MANY_VIEWS, FineTuning
from hyperplanes.fields import ImageBasedConfig, ImageBasedNeRF
from hyperplanes.fields.base import Field
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.volume import interpolate_grid
from hyperplanes.hypernetwork import VolumeHyperNetworkConfig
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.utilities.images.metrics import psnr
from tests.reference_rendering import awaken, ball_views, ring, small_model

PAPER = FineTuning(trainable="hypernetwork", rays=64, learning_rate=1e-2)
WEIGHTS = FineTuning(trainable="weights", rays=64, learning_rate=1e-2, muon_learning_rate=0.05)


@pytest.fixture
def model():
    return awaken(small_model())


@pytest.fixture
def support():
    return ball_views(ring(4))


@pytest.fixture
def few_held_out_rays(monkeypatch):
    """Evaluate held-out views with fewer rays than by default."""
    monkeypatch.setattr(descent_module, "HOLDOUT_RAYS", 256)


def moved(model, field):
    """The names of the parameters that differ from theta."""
    theta = model.theta.under("fine")
    return {name for name, value in field.parameters.items() if not torch.equal(value, theta[name])}


def test_the_error_of_an_empty_picture_is_that_of_white(model):
    grey = ball_views(ring(4))
    grey = replace(grey, images=torch.full_like(grey.images, 0.25))
    descent = make_descent(model, model.prepare(grey), WEIGHTS)
    assert descent.errors()[1] == 0.75**2


def test_the_contrast_of_a_pixel_is_the_range_of_the_colours_around_it():
    images = torch.full((1, 3, 4, 5), 0.2)
    images[0, 0, :, 3:] = 0.8  # one of three channels changes, between the columns 2 and 3
    torch.testing.assert_close(contrast(images), torch.tensor([0.0, 0.0, 0.2, 0.2, 0.0]).expand(1, 4, 5))
    images = torch.rand(2, 3, 6, 5, generator=torch.Generator().manual_seed(0))
    around = [max_pool2d(each, 3, 1, 1) for each in (images, -images)]
    torch.testing.assert_close(contrast(images), sum(around).mean(1))


@pytest.mark.parametrize("some", [False, True])
def test_the_weighted_mean_of_drawn_pixels_is_that_of_all(some):
    generator, count = torch.Generator().manual_seed(0), 200_000
    importance, values = torch.rand(50, generator=generator) + 0.05, torch.randn(50, generator=generator)
    among = torch.arange(50)[::3] if some else None
    drawn, weights = draw_pixels(importance, among, count, generator)
    chosen = torch.arange(50) if among is None else among
    often = torch.bincount(drawn, minlength=50)[chosen] / count
    torch.testing.assert_close(often, importance[chosen] / importance[chosen].sum(), atol=4e-3, rtol=0)
    assert set(drawn.tolist()) == set(chosen.tolist())
    assert float((weights[:, 0] * values[drawn]).mean()) == pytest.approx(float(values[chosen].mean()), abs=0.02)
    _, ones = draw_pixels(torch.full((7,), 0.3), None, 100, generator)
    torch.testing.assert_close(ones, torch.ones(100, 1))
    with pytest.raises(ValueError, match="among: expected at least one pixel to draw rays from, got none"):
        draw_pixels(importance, torch.arange(0), 1, generator)


def test_the_loss_weights_each_ray():
    seen = Rendered(*(torch.zeros(2, *shape) for shape in ((3,), (), ())), samples=0)
    truth = torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
    assert float(ray_loss(seen, truth)) == 2.5
    assert float(ray_loss(seen, truth, torch.tensor([[4.0], [0.0]]))) == 2.0
    assert float(ray_loss(replace(seen, coarse=seen), truth, torch.tensor([[4.0], [0.0]]))) == 4.0


@pytest.mark.parametrize(
    ("target", "trainable", "count", "draw", "cells"),
    [
        ("image_based", "weights", FINE_VIEWS, "contrast", 64),
        ("image_based", "weights", FINE_VIEWS - 1, "contrast", 0),
        ("image_based", "weights", MANY_VIEWS, "contrast", 0),
        ("image_based", "weights", MANY_VIEWS - 1, "uniform", 0),
        ("image_based", "hypernetwork", FINE_VIEWS, "uniform", 0),
        ("point_multiplane", "weights", FINE_VIEWS, "uniform", 0),
    ],
)
def test_the_number_of_views_determines_the_draw_and_the_cells(target, trainable, count, draw, cells):
    many = ball_views(ring(count))
    if target == "image_based":
        network = ImageBasedConfig(depth=2, width=16, grid=2)
        model = small_model(target=target, network=network, hypernetwork=VolumeHyperNetworkConfig())
    else:
        model = small_model(network=replace(small_model().config.network, planes=count))
        model.set_rig(many)
    settings = FineTuning(trainable, rays=8)
    context = model.prepare(many)
    assert len(context.given) == count
    found = make_descent(model, context, settings).settings
    assert (found.draw, found.cells) == (draw, cells)
    for stated in ("uniform", "contrast"):
        assert make_descent(model, context, replace(settings, draw=stated)).settings.draw == stated


@pytest.mark.parametrize(("cells", "optimised"), [(None, 64), (0, 32), (16, 32), (48, 48)])
def test_steps_optimise_a_finer_grid_which_is_saved_with_the_field(cells, optimised, tmp_path):
    network = ImageBasedConfig(depth=2, width=16, grid=2)
    model = small_model(target="image_based", network=network, hypernetwork=VolumeHyperNetworkConfig())
    views = ball_views(ring(FINE_VIEWS, (12, 12)))
    tuned = model.fine_tune(views, 2, FineTuning(rays=32, learning_rate=1e-3, cells=cells))
    assert tuned.field.parameters["grid.weight"].shape == (2, optimised, optimised, optimised)
    assert model.theta["fine.grid.weight"].shape[-1] == 32
    model.with_weights_of(tuned).save(tmp_path)
    kept = HyperPlanes.from_pretrained(tmp_path)
    assert kept.config.network.cells == optimised
    assert torch.equal(kept.adapt(views).render(ring(1)).images, tuned.render(ring(1)).images)
    further = kept.fine_tune(views, 1, FineTuning(rays=32, learning_rate=1e-3, cells=64))
    assert further.field.parameters["grid.weight"].shape[-1] == 64


def test_a_field_does_not_change_when_its_model_is_trained():
    """With and without a hypernetwork."""
    views = ball_views(ring(4, (12, 12)))
    for changes in ({}, {"hypernetwork": None}):
        model = small_model(**changes)
        field = model.adapt(views)
        before = field.render(views.cameras).images
        with torch.no_grad():
            for value in model.parameters():
                value.mul_(0.5)
        assert torch.equal(field.render(views.cameras).images, before)
        assert not torch.equal(model.adapt(views).render(views.cameras).images, before)


def test_weights_of_double_precision_are_kept_as_they_are():
    model = small_model(hypernetwork=None).double()
    with torch.no_grad():
        for value in model.parameters():
            value.mul_(1 + 1e-10)  # not representable in single precision
    views = ball_views(ring(4, (12, 12)))
    again = model.with_weights_of(model.adapt(views))
    assert all(torch.equal(value, again.theta[name]) for name, value in model.theta.items())


def test_weights_that_are_given_and_hypernetworks_keep_their_cells():
    network = ImageBasedConfig(depth=2, width=16, grid=2)
    model = small_model(target="image_based", network=network, hypernetwork=VolumeHyperNetworkConfig())
    views = ball_views(ring(FINE_VIEWS, (12, 12)))
    context = model.prepare(views)
    descent = make_descent(model, context, FineTuning(cells=48), start=model.theta)
    assert descent.settings.cells == 0
    assert descent.weights()["fine.grid.weight"].shape[-1] == 32
    with pytest.raises(ValueError, match="cells: expected None or 0 for a hypernetwork"):
        model.fine_tune(views, 2, FineTuning("hypernetwork", cells=64))
    other = small_model(target="image_based", network=replace(network, width=8), hypernetwork=None)
    with pytest.raises(ValueError, match="adapted: expected a field of this model"):
        other.with_weights_of(model.adapt(views))


def test_a_finer_grid_has_the_same_linear_features():
    """Closed form: interpolation does not change features that are linear along an axis."""
    network = ImageBasedNeRF(ImageBasedConfig(depth=2, width=16, planes=2, grid=3))
    places = (torch.arange(32.0) + 0.5) / 16 - 1
    ramps = torch.stack(torch.meshgrid(places, places, places, indexing="ij"))
    weights = Parameters({**Parameters.of(network), "grid.weight": ramps})
    points = (2 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) - 1) * (places[-2])
    for cells in (32, 64, 48):
        finer = network.finer(weights, cells)
        assert finer["grid.weight"].shape == (3, cells, cells, cells)
        torch.testing.assert_close(interpolate_grid(finer["grid.weight"], points, Sphere()), points)
        assert network.config_of(finer).cells == cells
    assert network.finer(weights, 16) is weights


def test_the_draw_of_pixels_changes_the_result(model, support):
    tuned = [
        model.fine_tune(support, 2, replace(WEIGHTS, draw=draw)).render(ring(1)).images
        for draw in (None, "uniform", "contrast")
    ]
    assert torch.equal(tuned[0], tuned[1])
    assert not torch.equal(tuned[1], tuned[2])
    with pytest.raises(ValueError, match="draw: expected one of .*, got 'random'"):
        replace(WEIGHTS, draw="random")


@pytest.mark.parametrize("settings", [PAPER, WEIGHTS])
def test_the_model_does_not_change_by_a_bit(model, support, settings):
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model.fine_tune(support, 3, settings)
    after = model.state_dict()
    assert set(after) == set(before)
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert all(value.grad is None for value in model.parameters())


def test_fine_tuning_the_hypernetwork_changes_only_the_updated_layers(model, support):
    fields = [model.fine_tune(support, steps, PAPER).field for steps in (0, 4)]
    for name, value in model.theta.under("fine").items():
        first, last = fields[0].parameters[name], fields[1].parameters[name]
        if name.split(".")[0] in ("colour", "density"):
            assert not torch.equal(first, last)
        else:
            assert torch.equal(first, value)
            assert torch.equal(last, value)
        assert not last.requires_grad


def test_fine_tuning_the_weights_changes_all_of_them(model, support):
    field = model.fine_tune(support, 3, WEIGHTS).field
    assert moved(model, field) == set(model.theta.under("fine"))
    assert not any(value.requires_grad for value in field.parameters.values())


@pytest.mark.parametrize("settings", [PAPER, WEIGHTS])
def test_zero_steps_are_adapting(model, support, settings):
    cameras = ring(1, shift=1)
    tuned = model.fine_tune(support, 0, settings).render(cameras).images
    assert torch.equal(tuned, model.adapt(support).render(cameras).images)


@pytest.mark.parametrize("settings", [PAPER, WEIGHTS, replace(WEIGHTS, optimiser="adam")])
def test_more_steps_fit_the_support_views_better(model, support, settings):
    quality = [
        psnr(model.fine_tune(support, steps, settings).render(support.cameras).images, support.images).mean()
        for steps in (0, 15)
    ]
    assert quality[1] > quality[0] + 1


def test_the_seed_decides(model, support):
    def picture(seed):
        return model.fine_tune(support, 3, replace(WEIGHTS, seed=seed)).render(ring(1)).images

    before = torch.random.get_rng_state()
    assert torch.equal(picture(1), picture(1))
    assert not torch.equal(picture(1), picture(2))
    assert torch.equal(before, torch.random.get_rng_state())


def test_fine_tuning_works_inside_no_grad(model, support):
    with torch.no_grad():
        tuned = model.fine_tune(support, 2, WEIGHTS)
    assert not torch.equal(tuned.render(ring(1)).images, model.adapt(support).render(ring(1)).images)


def test_the_coarse_network_is_fine_tuned_too(support):
    # the hypernetwork outputs zero, so that only a loss of the coarse picture can change the coarse weights
    both = small_model(coarse_network=True, sampling=Hierarchical(6, 6))
    tuned = both.fine_tune(support, 1, PAPER)
    for part, field in (("fine", tuned.field), ("coarse", tuned.proposal)):
        theta = both.theta.under(part)
        changed = {name for name, value in field.parameters.items() if not torch.equal(value, theta[name])}
        assert changed == {"colour.weight", "density.weight", "colour.bias", "density.bias"}


def test_a_model_without_a_hypernetwork_has_weights_to_tune_and_no_hypernetwork(support):
    plain = small_model(hypernetwork=None)
    assert moved(plain, plain.fine_tune(support, 1, WEIGHTS).field)
    with pytest.raises(ValueError, match="fine_tune: expected a model with a hypernetwork, got one without"):
        plain.fine_tune(support, 1, PAPER)


def test_wrong_settings_are_refused(model, support):
    with pytest.raises(ValueError, match="steps: expected 0 or more, or 'auto', got -1"):
        model.fine_tune(support, -1)
    with pytest.raises(ValueError, match="steps: expected at least 3 support views .*, got 2"):
        model.fine_tune(support[:2], "auto")


@pytest.mark.usefixtures("few_held_out_rays")
def test_auto_takes_no_step_if_all_steps_make_held_out_views_worse(model, support):
    taken, tried = [], []
    ruinous = replace(WEIGHTS, learning_rate=1e30, muon_learning_rate=1e30, max_steps=12)  # NaN after the first step
    field = model.fine_tune(support, "auto", ruinous, on_step=taken.append, on_trial=tried.append)
    assert taken == [0]
    assert tried == [0, 1, 2, 3]  # three checks
    cameras = ring(1, shift=1)
    assert torch.equal(field.render(cameras).images, model.adapt(support).render(cameras).images)


@pytest.mark.usefixtures("few_held_out_rays")
def test_auto_continues_while_held_out_views_get_better():
    model, support, taken, tried = awaken(small_model()), ball_views(ring(9)), [], []
    field = model.fine_tune(
        support, "auto", replace(WEIGHTS, max_steps=40, holdout=3), on_step=taken.append, on_trial=tried.append
    )
    assert tried == list(range(max(tried) + 1))
    assert max(taken) <= max(tried) <= 40
    assert taken[-1] >= 12
    query = ball_views(ring(4, shift=1))
    quality = [psnr(each.render(query.cameras).images, query.images).mean() for each in (model.adapt(support), field)]
    assert quality[1] > quality[0] + 3


def test_held_out_views_give_neither_planes_nor_rays_while_steps_are_chosen(model, monkeypatch):
    support, prepared, drawn = ball_views(ring(9)), [], []
    prepare, sample = HyperPlanes.prepare, type(support).sample_rays
    monkeypatch.setattr(
        HyperPlanes, "prepare", lambda self, views, **given: prepared.append(views) or prepare(self, views, **given)
    )

    def sampled(self, count, **given):
        drawn.append((len(self), count))
        return sample(self, count, **given)

    monkeypatch.setattr(type(support), "sample_rays", sampled)
    model.fine_tune(support, "auto", replace(WEIGHTS, max_steps=2, holdout=3))
    assert [len(views) for views in prepared] == [6, 9]
    assert drawn[0] == (3, 4096)  # the rays of the held-out views
    assert {count for views, count in drawn[1:]} == {64}
    assert {views for views, _ in drawn[1:]} <= {6, 9}


def test_the_method_fine_tunes_on_the_object(model, support):
    cameras = ring(1, shift=1)
    tuned = FineTuned(model, 2, WEIGHTS).adapt(support).render(cameras).images
    assert torch.equal(tuned, model.fine_tune(support, 2, WEIGHTS).render(cameras).images)


def test_from_scratch_uses_no_trained_weights(support):
    cameras = ring(1, shift=1)
    pictures = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        model = small_model()
        for value in model.parameters():
            torch.nn.init.normal_(value, std=0.1 + seed)
        pictures.append(FromScratch(model, 2, WEIGHTS).adapt(support).render(cameras).images)
    assert torch.equal(*pictures)
    other = FromScratch(small_model(), 2, replace(WEIGHTS, seed=1)).adapt(support).render(cameras).images
    assert not torch.equal(pictures[0], other)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trainable": "theta"}, "trainable: expected one of 'weights', 'hypernetwork', got 'theta'"),
        ({"optimiser": "lion"}, "optimiser: expected one of .*, got 'lion'"),
        ({"rays": 0}, "rays: expected at least 1, got 0"),
        ({"holdout": 1}, "holdout: expected at least 2, got 1"),
        ({"max_steps": 0}, "max_steps: expected at least 1, got 0"),
        ({"learning_rate": -1.0}, "learning_rate: expected a finite number of 0 or more, got -1.0"),
        ({"muon_learning_rate": float("nan")}, "muon_learning_rate: expected a finite number"),
        ({"cells": 300}, "cells: expected"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        FineTuning(**settings)


@pytest.mark.usefixtures("few_held_out_rays")
def test_auto_uses_the_same_settings_in_both_passes(monkeypatch):
    decided, made = [], fine_tuning.make_descent

    def noting(*given):
        descent = made(*given)
        decided.append((descent.settings.fresh, descent.settings.draw, descent.settings.cells))
        return descent

    monkeypatch.setattr(fine_tuning, "make_descent", noting)
    model = small_model(target="image_based", hypernetwork=None, network=ImageBasedConfig(depth=2, width=16))
    for count in (9, 10, 23, 24):
        decided.clear()
        model.fine_tune(ball_views(ring(count, (8, 8))), "auto", FineTuning(rays=16, max_steps=2, learning_rate=1e-4))
        assert len(decided) == 2
        assert set(decided) == {(0.5, "contrast", 64 * (count >= 20)) if count >= 10 else (0.0, "uniform", 0)}


@pytest.mark.usefixtures("few_held_out_rays")
def test_the_best_number_of_steps_is_compared_with_a_given_field():
    model, support = awaken(small_model()), ball_views(ring(9))
    shown, holdout = split_holdout(support, WEIGHTS)
    context = model.prepare(shown)
    bounds = support.bounds
    blank = AdaptedField(lambda p, d: (torch.ones_like(p), p.new_zeros(len(p))), full(bounds, 4), RayMarching(24))
    best = fine_tuning.fine_tune_to(model, context, 40, WEIGHTS)  # better than a few steps
    stops = [
        make_descent(model, context, replace(WEIGHTS, max_steps=10), shown).best_stop(holdout, unchanged=unchanged)
        for unchanged in (blank, best)
    ]
    assert stops[0] > stops[1] == 0


def test_gradients_of_parts_of_the_rays_sum_to_those_of_all_for_any_number_of_threads(model, support, monkeypatch):
    monkeypatch.setattr(descent_module, "PART", 12)
    descent = make_descent(model, model.prepare(support), WEIGHTS)
    field, (rays, truth) = descent.field(None), support.sample_rays(30, generator=torch.Generator().manual_seed(1))
    # one loss of the same rays; the samples of each part come from its own generator
    seeds = torch.randint(2**62, (3,), generator=torch.Generator().manual_seed(2)).tolist()
    parts = [(slice(12 * place, 12 * place + 12), seed) for place, seed in enumerate(seeds)]
    seen = [field.trace(rays[part], torch.Generator().manual_seed(seed)).colour for part, seed in parts]
    weights = torch.rand(30, 1, generator=torch.Generator().manual_seed(3))
    loss = (weights * (torch.cat(seen) - truth).square()).mean()
    expected = torch.autograd.grad(loss, descent.tensors, allow_unused=True)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(descent._gradients(field, rays, truth, torch.Generator().manual_seed(2), weights))
    finally:
        torch.set_num_threads(before)
    for one, two, whole in zip(*found, expected, strict=True):
        assert one is two is None if whole is None else torch.equal(one, two)
        torch.testing.assert_close(one, whole)


def test_a_field_that_is_not_thread_safe_is_called_by_one_thread(model, support, monkeypatch):
    monkeypatch.setattr(descent_module, "PART", 16)
    descent = make_descent(model, model.prepare(support), WEIGHTS)
    rays, truth = support.sample_rays(64, generator=torch.Generator().manual_seed(1))
    before, found = torch.get_num_threads(), {True: set(), False: set()}
    try:
        torch.set_num_threads(2)
        for safe, callers in found.items():

            def noting(*given, callers=callers):
                callers.add(threading.get_ident())
                return ray_loss(*given)

            monkeypatch.setattr(Field, "thread_safe", safe)
            monkeypatch.setattr(descent_module, "ray_loss", noting)
            descent._gradients(descent.field(None), rays, truth, torch.Generator())
    finally:
        torch.set_num_threads(before)
    assert found[False] == {threading.get_ident()}
    assert threading.get_ident() not in found[True]
