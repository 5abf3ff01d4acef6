"""Source of truth: closed forms of the plain hull and of what lies halfway, and which views may decide."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.nn.functional import softplus

from hyperplanes.adaptation import AdaptedField, HyperPlanes, ModelConfig, judging
from hyperplanes.adaptation.descent import Descent, split_holdout
from hyperplanes.adaptation.fine_tuned import random_model
from hyperplanes.adaptation.fine_tuning import fine_tune
from hyperplanes.adaptation.judging import FEWEST, STRENGTHS, judge_strength
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.fields import ImageBasedConfig
from hyperplanes.fields.image_based import EMPTY, SOLID
from hyperplanes.geometry.cameras import centres
from hyperplanes.hypernetwork import VolumeHyperNetworkConfig
from hyperplanes.rendering import RayMarching
from hyperplanes.training import TrainingConfig
from hyperplanes.training.validation import Validator
from hyperplanes.views import Views
from tests.reference_rendering import Balls, awaken, ball_views, ring

NETWORK = ImageBasedConfig(depth=2, width=16, planes=4, blended=2, grid=5, point_frequencies=2, direction_frequencies=1)
CONFIG = ModelConfig(
    "image_based", NETWORK, VolumeHyperNetworkConfig(), sampling=RayMarching(24), hull_resolution=16, judged=True
)


def model(seed=0):
    torch.manual_seed(seed)
    made = awaken(HyperPlanes(CONFIG, seed)).eval()
    with torch.no_grad():
        made.networks["fine"].density.weight *= 5
        made.networks["fine"].colour.weight *= 5
    return made


@torch.no_grad()
def outputs(adapter, context, strength, points, directions):
    """Density before softplus, and what the network changes of the blend's logit, at points."""
    weights = adapter.attenuated(adapter.theta + adapter.update(context), strength)
    field = adapter.field(context, weights)
    colour, density = field(points, directions)
    scale = NETWORK.density_scale / context.occupancy.bounds.radius
    return torch.log(torch.expm1((density / scale).double())), colour


@torch.no_grad()
def test_nothing_of_what_was_learned_is_the_hull_of_the_masks_in_blended_colours():
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(200, 3, generator=generator) - 0.5
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1)
    support = ball_views(ring(6, (24, 24)))
    one, other = model(), model(seed=7)
    context = one.prepare(support)
    coverage = context.planes.choose(points, best=1).coverage
    scale = NETWORK.density_scale / context.occupancy.bounds.radius
    colours = []
    for adapter in (one, other):  # other weights, the same plain hull
        field = adapter.field(context, adapter.attenuated(adapter.theta + adapter.update(context), 0.0))
        colour, density = field(points, directions)
        torch.testing.assert_close(density, softplus(EMPTY + (SOLID - EMPTY) * coverage) * scale)
        colours.append(colour)
    assert torch.equal(*colours)


def test_halfway_the_density_before_softplus_is_the_mean_of_both():
    generator = torch.Generator().manual_seed(2)
    points = torch.rand(100, 3, generator=generator) - 0.5
    adapter = model()
    context = adapter.prepare(ball_views(ring(6, (24, 24))))
    whole, half, none = (outputs(adapter, context, each, points, points)[0] for each in STRENGTHS)
    torch.testing.assert_close(half, (whole + none) / 2, atol=1e-3, rtol=1e-3)
    assert not torch.allclose(whole, none, atol=0.1)


@pytest.mark.parametrize(
    ("errors", "expected"),
    [((4.0, 3.1, 3.5), 1.0), ((4.0, 2.9, 3.5), 0.5), ((4.0, 2.9, 2.8), 0.0), ((4.0, 5.0, 6.0), 1.0)],
)
def test_less_is_taken_of_what_was_learned_only_where_it_is_better_by_a_quarter(monkeypatch, errors, expected):
    """Two views tell smaller differences wrongly: without the margin planes lost up to 4.4 dB (docs/small.md)."""
    remaining = iter(errors)
    monkeypatch.setattr(Views, "sample_rays", lambda *_, **__: (None, torch.zeros(8, 3)))
    monkeypatch.setattr(
        AdaptedField, "trace", lambda *_, **__: SimpleNamespace(colour=torch.full((8, 3), next(remaining) ** 0.5))
    )
    assert judge_strength(model(), ball_views(ring(6, (24, 24)))) == expected


def test_the_views_that_decide_are_not_shown(monkeypatch):
    adapter, support, shown = model(), ball_views(ring(7, (24, 24))), []
    prepare = adapter.prepare
    monkeypatch.setattr(adapter, "prepare", lambda views, **given: shown.append(views) or prepare(views, **given))
    assert judge_strength(adapter, support) in STRENGTHS
    (rest,) = shown
    assert len(rest) == 5
    apart = torch.cdist(centres(support.cameras), centres(rest.cameras)).amin(1)
    assert int((apart > 1e-3).sum()) == 2


def test_the_strength_is_the_one_that_shows_the_left_out_views_best():
    """The truth itself as the field of one strength, and its negative as those of the others."""
    adapter, support = model(), ball_views(ring(8, (24, 24)))
    for best in STRENGTHS:
        changed = model()
        changed.attenuated = lambda weights, strength, best=best: adapter.attenuated(weights, float(strength != best))
        adapter.theta["fine.density.bias"].data.fill_(-50)  # what was learned is that there is nothing
        assert judge_strength(changed, support) == best


def test_with_fewer_views_all_that_was_learned_is_used():
    adapter = model()
    for count in (1, FEWEST - 1):
        assert judge_strength(adapter, ball_views(ring(count, (24, 24)))) == 1


def test_a_field_that_knows_views_by_their_places_has_no_plain_hull():
    with pytest.raises(ValueError, match="judged: .* got point_multiplane"):
        HyperPlanes(replace(ModelConfig(), judged=True))


def test_the_weights_of_one_object_are_not_judged_again():
    adapter, support = model(), ball_views(ring(7, (24, 24)))
    adapter.theta["fine.density.bias"].data.fill_(-50)  # what was learned is that there is nothing
    adapted = adapter.adapt(support)
    again = adapter.with_weights_of(adapted).adapt(support)
    cameras = ring(2, (10, 13), shift=1)
    torch.testing.assert_close(again.render(cameras).images, adapted.render(cameras).images, atol=1e-6, rtol=0)
    assert not random_model(adapter.config, 0).config.judged


def test_the_control_of_another_objects_update_is_attenuated_as_the_object_is(monkeypatch):
    adapter, supports = model(), [ball_views(ring(6, (24, 24)), radius=radius) for radius in (0.4, 0.7)]
    swapped, cameras = Swapped(adapter, supports), ring(1, (24, 24), shift=1)
    for strength in STRENGTHS:
        monkeypatch.setattr(judging, "judge_strength", lambda network, support, strength=strength: strength)
        own, other = (each.adapt(supports[0]).render(cameras).images for each in (adapter, swapped))
        assert torch.equal(own, other) == (strength == 0.0)  # nothing of what was learned: the same plain hull


def test_the_swap_gap_of_a_validation_compares_fields_that_are_not_attenuated(monkeypatch):
    adapter, data = model(), Balls(test=2)
    settings = TrainingConfig(steps=1, tasks=1, rays=8, held_out=2)
    validator = Validator(adapter, data, settings, adapter.adapt_to)
    whole = validator.run()
    monkeypatch.setattr(judging, "judge_strength", lambda network, support: 0.0)
    attenuated = validator.run()
    assert attenuated.psnr != whole.psnr
    assert attenuated.diagnostics.swap_gap == whole.diagnostics.swap_gap


def test_auto_compares_steps_with_the_field_that_no_step_returns(monkeypatch):
    seen, adapter, support = [], model(), ball_views(ring(12, (16, 16)))

    def best_stop(self, holdout, *, unchanged, **given):
        seen.append((unchanged.render(holdout.cameras).images, self.field(None).render(holdout.cameras).images))
        return 0

    prepare, shown = adapter.prepare, []
    monkeypatch.setattr(adapter, "prepare", lambda views, **given: shown.append(views) or prepare(views, **given))
    monkeypatch.setattr(Descent, "best_stop", best_stop)
    monkeypatch.setattr(judging, "judge_strength", lambda network, support: 0.5)
    fine_tune(adapter, support, "auto", FineTuning(rays=8, max_steps=3))
    ((unchanged, begun),) = seen
    cameras = split_holdout(support, FineTuning())[1].cameras
    torch.testing.assert_close(adapter.adapt(shown[0]).render(cameras).images, unchanged, atol=1e-4, rtol=0)
    assert (begun - unchanged).abs().max() > 0.01  # half of the weights that steps begin with are random
