"""Sources of truth: the minimum of a quadratic function on a grid, means of pictures, and which views are held out."""

import threading
from dataclasses import replace
from functools import cache

import pytest
import torch

from hyperplanes.adaptation import AdaptedField, HullBlend, HyperPlanes, ModelConfig
from hyperplanes.adaptation.context import live_pixels
from hyperplanes.adaptation.correction import held_out, stacking
from hyperplanes.adaptation.correction.held_out import EVEN, HELD_OUT_PIXELS, MIN_HELD_OUT, MIN_VIEWS, hold_out
from hyperplanes.adaptation.correction.stacking import (
    CAUTION,
    MIN_ERROR_REDUCTION,
    StackedField,
    average,
    best_share,
    hull_share,
    learned_part,
    stack,
)
from hyperplanes.adaptation.fine_tuned import random_model
from hyperplanes.adaptation.fine_tuning import fine_tune
from hyperplanes.adaptation.gating import GatingNetwork
from hyperplanes.adaptation.optimisation.descent import Descent, contrast, split_holdout
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.commands.inputs.disk_cache import keep_field, recall_field
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.fields import ImageBasedConfig
from hyperplanes.fields.base import Field
from hyperplanes.geometry.cameras import centres
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.poses import outermost_first
from hyperplanes.geometry.rays import SUBPIXELS, Sphere, cast
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.hypernetwork import VolumeHyperNetworkConfig
from hyperplanes.rendering import Hierarchical, RayMarching, render
from hyperplanes.training import TrainingConfig
from hyperplanes.training.validation import Validator
from hyperplanes.utilities.images.metrics import psnr
from tests.reference_rendering import Balls, awaken, ball_views, ring

NETWORK = ImageBasedConfig(depth=2, width=16, planes=4, blended=2, grid=5, point_frequencies=2, direction_frequencies=1)
CONFIG = ModelConfig(
    "image_based", NETWORK, VolumeHyperNetworkConfig(), sampling=RayMarching(24), hull_resolution=16, stacked=True
)

ACROSS = Symmetry(Plane((1.0, 0.0, 0.0)))


def model(seed=0, *, empty=False):
    torch.manual_seed(seed)
    made = awaken(HyperPlanes(CONFIG, seed)).eval()
    with torch.no_grad():
        made.networks["fine"].density.weight *= 5
        made.networks["fine"].colour.weight *= 5
        if empty:  # the learned field is empty
            made.theta["fine.density.bias"].fill_(-50)
    return made


def both(support, symmetry=None):
    """The learned field and the hull blend of the same views and, with a symmetry, of their reflections."""
    adapter = model()
    context = adapter.prepare(support, symmetry=symmetry)
    return adapter.rendering_field(context, adapter.adapted_weights(context)), HullBlend().adapt_to(context.planes)


@cache
def both_of_reflected():
    """Both fields of seven views and their reflections."""
    return both(ball_views(ring(7, (24, 24))), ACROSS)


@pytest.mark.parametrize(("given", "held_out"), [(5, 2), (35, 2), (36, 3), (48, 4)])
def test_two_views_are_held_out_or_one_in_twelve(given, held_out):
    trial = hold_out(model(), ball_views(ring(given, (12, 12))))
    assert len(trial.context.given) == given - held_out


def test_the_best_share_has_the_least_squared_error_of_a_grid():
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        one, other = torch.randn(2, 40, 3, generator=generator) + torch.randn(2, 1, 3, generator=generator)
        grid = torch.linspace(0, 1, 1001)
        errors = torch.stack([torch.lerp(one, other, float(share)).square().mean() for share in grid])
        assert best_share(one, other) == pytest.approx(float(grid[errors.argmin()]), abs=1e-3)


def test_the_share_of_a_perfect_prediction_is_1_and_of_a_useless_one_0():
    error = torch.rand(7, 3) + 0.1
    assert best_share(error, torch.zeros(7, 3)) == 1
    assert best_share(torch.zeros(7, 3), error) == 0
    assert best_share(error, 2 * error) == 0
    assert best_share(error, error) == 0


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_pictures_and_pixels_are_the_mean_of_both_fields(share):
    learned, hull = both(ball_views(ring(6, (24, 24))))
    stacked, cameras = stack(learned, hull, share), ring(2, (10, 13), shift=1)
    one, other, mixed = (each.render(cameras) for each in (learned, hull, stacked))
    torch.testing.assert_close(mixed.images, torch.lerp(one.images, other.images, share))
    torch.testing.assert_close(mixed.opacity, torch.lerp(one.opacity, other.opacity, share))
    known = (one.depth > 0) & (other.depth > 0)
    moments = (each.opacity * each.depth for each in (one, other))
    torch.testing.assert_close((mixed.opacity * mixed.depth)[known], torch.lerp(*moments, share)[known])
    assert mixed.samples == one.samples + other.samples
    view, pixels = torch.zeros(5, dtype=torch.long), torch.rand(5, 2) * 4 + 4
    rays = cast(cameras, view, pixels, learned.occupancy.bounds)
    one, other, mixed = (each.trace(rays, differentiable=False) for each in (learned, hull, stacked))
    torch.testing.assert_close(mixed.colour, torch.lerp(one.colour, other.colour, share))


def test_a_pixel_without_depth_in_one_picture_has_that_of_the_other():
    """The hull has no depth where the middle of a pixel misses it, but may have opacity there, by the pixel's rays."""
    learned, hull = both(ball_views(ring(6, (24, 24))))
    one = learned.render(ring(2, (10, 13), shift=1))
    without = replace(one, depth=torch.zeros_like(one.depth))
    found = stack(learned, hull, 0.4)._mean(one, without).depth
    assert one.depth.max() > 0
    torch.testing.assert_close(found, one.depth * (one.opacity > 0))


def test_two_threads_make_the_pictures_of_one():
    support, found = ball_views(ring(6, (40, 40))), []
    field, before = stack(*both(support), 0.4), torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(field.render(support.cameras))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0].images, found[1].images)
    assert torch.equal(found[0].depth, found[1].depth)


@pytest.mark.parametrize("safe", [True, False])
def test_fields_that_are_not_thread_safe_are_rendered_in_one_thread(safe):
    ran, before = set(), torch.get_num_threads()

    class Plain:
        thread_safe = safe

        def __call__(self, points, directions):
            ran.add(threading.get_ident())
            return torch.zeros_like(points), torch.ones(len(points))

    plain = AdaptedField(Plain(), full(Sphere(), 4), RayMarching(8))
    try:
        torch.set_num_threads(2)
        stack(plain, plain, 0.4).render(ring(1, (16, 16)))
    finally:
        torch.set_num_threads(before)
    assert (ran == {threading.get_ident()}) == (not safe)


def test_a_model_in_double_precision_is_stacked_too():
    support, cameras = ball_views(ring(6, (24, 24))), ring(1, (10, 13), shift=1)
    adapter = model()
    context = adapter.prepare(support)
    double = adapter.double().prepare(support)
    one, other = (HullBlend().adapt_to(each.planes).render(cameras) for each in (context, double))
    torch.testing.assert_close(one.images, other.images, atol=2e-2, rtol=0)
    learned = adapter.rendering_field(double, adapter.adapted_weights(double))
    stacked = stack(learned, HullBlend().adapt_to(double.planes), 0.3)
    assert stacked.render(cameras).images.dtype == torch.float32
    for field in (stack(*both(support), 0.3), stacked):
        for dtype in (torch.float32, torch.float64):
            assert field.trace(support.rays(0).to(dtype), differentiable=False).colour.dtype == field.dtype
    expected = hull_share(hold_out(model(empty=True), support))
    assert hull_share(hold_out(model(empty=True).double(), support.to(dtype=torch.float64))) == pytest.approx(
        expected, abs=1e-3
    )


def test_densities_are_those_of_the_learned_field_unless_the_share_of_the_hull_is_high():
    learned, hull = both(ball_views(ring(6, (24, 24))))
    points = torch.rand(50, 3) - 0.5
    for share, heavier in ((0.2, learned), (0.8, learned), (0.95, hull)):
        assert torch.equal(stack(learned, hull, share).density(points), heavier.density(points))
    assert stack(learned, hull, 0.0) is learned
    cameras = ring(1, (10, 13), shift=1)
    assert torch.equal(stack(learned, hull, 1.0).render(cameras).images, hull.render(cameras).images)


def test_held_out_views_are_not_given_to_the_model(monkeypatch):
    adapter, support, shown = model(), ball_views(ring(7, (24, 24))), []
    prepare = adapter.prepare
    monkeypatch.setattr(adapter, "prepare", lambda views, **given: shown.append(views) or prepare(views, **given))
    assert 0 <= hull_share(hold_out(adapter, support)) <= 1
    (rest,) = shown
    assert len(rest) == 5
    kept = sorted(outermost_first(support.camera_directions, 7)[:-2])  # without the innermost views
    torch.testing.assert_close(centres(rest.cameras), centres(support.cameras)[kept])
    apart = torch.cdist(centres(support.cameras), centres(rest.cameras)).amin(1)
    assert int((apart > 1e-3).sum()) == 2


def test_if_the_learned_field_is_empty_the_hull_has_a_high_share():
    adapter, support, cameras = model(empty=True), ball_views(ring(8, (24, 24))), ring(3, (24, 24), shift=1)
    adapted = adapter.adapt(support)
    assert isinstance(adapted, StackedField)
    assert learned_part(adapted).share > 0.8
    assert isinstance(adapted.other.field, Field)  # densities are those of the hull
    truth = ball_views(cameras).images
    alone = replace(adapter.config, stacked=False)
    without = HyperPlanes(alone)
    without.load_state_dict(adapter.state_dict())
    gained = psnr(adapted.render(cameras).images, truth) - psnr(without.adapt(support).render(cameras).images, truth)
    assert (gained > 6).all()


@pytest.mark.parametrize("other", [1.0, 2.0, 7.0])
def test_fields_are_stacked_only_if_the_error_decreases_enough(monkeypatch, other):
    """Closed form: with errors 1 and e, the squared error (1 - s)^2 + s^2 e^2 is least for s = 1 / (1 + e^2)."""
    pixels = iter([torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, other, 0.0]])])
    support = ball_views(ring(6, (24, 24)))
    monkeypatch.setattr(held_out.HeldOutPixels, "errors", lambda *_: next(pixels))
    share = (1 / (1 + other**2)) ** CAUTION
    worth_it = (1 - share) ** 2 + share**2 * other**2 < 1 - MIN_ERROR_REDUCTION
    assert hull_share(hold_out(model(), support)) == pytest.approx(share if worth_it else 0.0)
    assert worth_it == (other < 5)


@pytest.mark.parametrize("even", [-1.0, 0.02, EVEN, 1.0])
def test_held_out_pixels_with_contrast_are_the_mean_of_three_rays(monkeypatch, even):
    """Brute force: three rays for every pixel."""
    monkeypatch.setattr(held_out, "EVEN", even)
    adapter, support = model(), ball_views(ring(8, (24, 24)))
    order = outermost_first(support.camera_directions, len(support))
    held = support[order[-MIN_HELD_OUT:]]
    trial = hold_out(adapter, support)
    among, generators = live_pixels(trial.context.occupancy, held), [torch.Generator().manual_seed(0) for _ in range(2)]
    rays, truth, _ = held.sample_masked_rays(HELD_OUT_PIXELS, generator=generators[0], among=among, subpixels=SUBPIXELS)
    chosen = among[torch.randint(len(among), (HELD_OUT_PIXELS,), generator=generators[1])]
    finer, field = trial.learned.sampling.for_rendering(trial.pixels.across), trial.learned
    found = render(field.field, rays, finer, occupancy=field.occupancy, differentiable=False)
    three, one = found.pooled(3).colour, found.colour[:HELD_OUT_PIXELS]
    uneven = contrast(held.images).flatten()[chosen] > even
    assert len(trial.pixels.even) == int((~uneven).sum())
    assert len(trial.pixels.uneven) == 3 * int(uneven.sum())
    expected = torch.cat([(one - truth)[~uneven], (three - truth)[uneven]])
    torch.testing.assert_close(trial.pixels.errors(field), expected)
    assert uneven.all() == (even < 0)
    assert uneven.any() == (even < 1)
    assert (three - one).abs().max() > 0.01


def test_few_views_or_views_without_masks_give_no_share():
    adapter = model()
    for count in (1, MIN_VIEWS - 1):
        assert hull_share(hold_out(adapter, ball_views(ring(count, (24, 24))))) == 0
    support = ball_views(ring(6, (24, 24)))
    assert hull_share(hold_out(model(empty=True), replace(support, masks=None))) == 0
    few = support.masks.clone()
    few[sorted(outermost_first(support.camera_directions, 6)[:-2])] = 0
    assert hull_share(hold_out(model(empty=True), replace(support, masks=few))) == 0  # masks of given views are empty
    saved = HyperPlanes(replace(CONFIG, stacked=False, hull_share=0.5))
    with pytest.warns(UserWarning, match="no alpha and no masks"):
        assert not isinstance(saved.adapt(replace(support, masks=None)), StackedField)
    assert isinstance(saved.adapt(support), StackedField)


def test_held_out_views_without_the_object_give_no_share(monkeypatch):
    support = ball_views(ring(6, (24, 24)))
    assert hull_share(hold_out(model(empty=True), support)) > 0
    monkeypatch.setattr(held_out, "live_pixels", lambda *_: torch.arange(0))
    assert hull_share(hold_out(model(empty=True), support)) == 0


def test_stacking_a_field_with_fixed_planes_is_refused():
    with pytest.raises(ValueError, match="stacked: .* got point_multiplane"):
        HyperPlanes(replace(ModelConfig(), stacked=True))
    with pytest.raises(ValueError, match="gated: .* got point_multiplane"):
        HyperPlanes(replace(ModelConfig(), gated=True))
    with pytest.raises(ValueError, match="hull_share: .* got point_multiplane"):
        HyperPlanes(replace(ModelConfig(), hull_share=0.5))
    with pytest.raises(ValueError, match=r"hull_share: expected 0 for a stacked model"):
        replace(CONFIG, hull_share=0.5)
    with pytest.raises(ValueError, match="hull_share: expected a share"):
        replace(CONFIG, stacked=False, hull_share=1.5)
    learned, hull = both(ball_views(ring(5, (24, 24))))
    with pytest.raises(ValueError, match="stack: expected fields that are not stacked"):
        stack(stack(learned, hull, 0.3), hull, 0.3)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.8, 1.0])
def test_weights_of_one_object_reproduce_its_stacked_pictures(tmp_path, share, gated):
    adapter, support, cameras = model(), ball_views(ring(7, (24, 24))), ring(2, (10, 13), shift=1)
    gate = GatingNetwork() if gated else None
    stacked = stack(*both_of_reflected(), share, gate, views=14)
    keep_field(adapter, stacked, tmp_path / "adapted" / "kept")
    expected = stacked.render(cameras).images
    assert stacked.symmetry == ACROSS
    for again in (
        adapter.with_weights_of(stacked).adapt(support),
        recall_field(tmp_path / "adapted" / "kept", support),
    ):
        torch.testing.assert_close(again.render(cameras).images, expected, atol=1e-6, rtol=0)
    fresh = random_model(replace(adapter.config, gated=gated), 0).config
    assert not fresh.stacked
    assert not fresh.gated


def test_another_sampler_applies_to_both_fields_of_an_average():
    learned, _ = both(ball_views(ring(5, (24, 24))))
    averaged, other, cameras = average(learned, learned, 0.5), Hierarchical(4, 4), ring(1, (12, 12), shift=1)
    expected = learned.render(cameras, other)
    for found in (averaged.with_sampling(other).render(cameras), averaged.render(cameras, other)):
        torch.testing.assert_close(found.images, expected.images)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_another_sampler_applies_only_to_the_learned_field_of_a_stack(share):
    learned, hull = both(ball_views(ring(5, (24, 24))))
    stacked = stack(learned, hull, share)
    assert stacked.overruled == (share == 0.9)
    dense, cameras = RayMarching(3), ring(1, (12, 12), shift=1)
    parts = stacked.with_sampling(dense)
    parts = (parts.other, parts) if parts.overruled else (parts, parts.other)
    assert [each.sampling for each in parts] == [dense, hull.sampling]
    expected = stack(replace(learned, sampling=dense), hull, share)
    for found in (stacked.with_sampling(dense).render(cameras), expected.render(cameras)):
        torch.testing.assert_close(found.images, expected.render(cameras).images)
    given, kept = stacked.render(cameras, RayMarching(2, 0.0)), stacked.render(cameras)
    assert not torch.equal(given.images, kept.images)
    of_hull = hull.render(cameras).samples
    assert given.samples - learned.render(cameras, RayMarching(2, 0.0)).samples == of_hull


def test_a_field_with_a_swapped_update_is_stacked_with_the_same_share(monkeypatch):
    adapter, supports = model(), [ball_views(ring(6, (24, 24)), radius=radius) for radius in (0.4, 0.7)]
    swapped, cameras = Swapped(adapter, supports), ring(1, (24, 24), shift=1)
    for share in (0.0, 0.5, 1.0):
        monkeypatch.setattr(stacking, "hull_share", lambda *_, share=share: share)
        own, other = (each.adapt(supports[0]).render(cameras).images for each in (adapter, swapped))
        assert torch.equal(own, other) == (share == 1.0)  # only the hull


def test_the_swap_gap_of_a_validation_compares_fields_that_are_not_stacked(monkeypatch):
    adapter, data = model(), Balls(test=2)
    settings = TrainingConfig(steps=1, tasks=1, rays=8, held_out=2)
    validator = Validator(adapter, data, settings, adapter.adapt_to)
    monkeypatch.setattr(stacking, "hull_share", lambda *_: 0.0)
    alone = validator.run()
    monkeypatch.setattr(stacking, "hull_share", lambda *_: 0.6)
    stacked = validator.run()
    assert stacked.psnr != alone.psnr
    assert stacked.diagnostics.swap_gap == alone.diagnostics.swap_gap


def test_auto_compares_steps_with_the_adapted_field(monkeypatch):
    seen, adapter, support = [], model(), ball_views(ring(12, (16, 16)))

    def best_stop(self, holdout, *, unchanged, **given):
        seen.append((unchanged.render(holdout.cameras).images, self.field(None).render(holdout.cameras).images))
        return 0

    prepare, shown = adapter.prepare, []
    monkeypatch.setattr(adapter, "prepare", lambda views, **given: shown.append(views) or prepare(views, **given))
    monkeypatch.setattr(Descent, "best_stop", best_stop)
    monkeypatch.setattr(stacking, "hull_share", lambda *_: 0.0)
    fine_tune(adapter, support, "auto", FineTuning(rays=8, max_steps=3))
    ((unchanged, begun),) = seen
    cameras = split_holdout(support, FineTuning())[1].cameras
    torch.testing.assert_close(adapter.adapt(shown[0]).render(cameras).images, unchanged, atol=1e-4, rtol=0)
    assert (begun - unchanged).abs().max() > 0.01  # the initial weights of the steps are half random
