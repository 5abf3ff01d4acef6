"""Source of truth: means of the pictures after gradient steps and of those before them, computed here."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.context import trained_on
from hyperplanes.adaptation.correction.stacking import AveragedField
from hyperplanes.adaptation.fine_tuned import FromScratch
from hyperplanes.adaptation.fine_tuning import fine_tune_to, ignoring_no_progress, make_descent
from hyperplanes.adaptation.optimisation import descent
from hyperplanes.adaptation.optimisation.descent import split_holdout
from hyperplanes.adaptation.optimisation.learned_steps import updated_weights
from hyperplanes.configuration.fine_tuning import AVERAGE, MANY_VIEWS, FineTuning
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from tests.adaptation.test_learned_steps import stepping
from tests.reference_rendering import ball_views, ring

FEW = FineTuning(rays=32)
CAMERAS = ring(2, (10, 13), shift=1)


def pictures(field):
    return field.render(CAMERAS).images


@pytest.mark.parametrize("count", [2, 3, 5])
def test_pictures_after_steps_on_few_views_are_means_with_those_before_them(count):
    adapter, support = stepping(), ball_views(ring(count))
    tuned, alone = adapter.fine_tune(support, 3, FEW), adapter.fine_tune(support, 3, replace(FEW, average=0))
    context = adapter.prepare(support)
    before = adapter.rendering_field(context, updated_weights(adapter, context))
    assert not torch.allclose(pictures(alone), pictures(before), atol=1e-2)
    share = AVERAGE / max(3, count)
    assert_close(pictures(tuned), torch.lerp(pictures(alone), pictures(before), share))
    rays, _ = support.sample_rays(20, generator=torch.Generator().manual_seed(0))
    traced = [each.trace(rays, differentiable=False).colour for each in (tuned, alone, before)]
    assert_close(traced[0], torch.lerp(traced[1], traced[2], share))
    assert_close(tuned.density(rays.at(rays.near + 1)), alone.density(rays.at(rays.near + 1)))


def test_steps_on_few_views_begin_after_the_learned_ones():
    adapter, still = stepping(), replace(FEW, learning_rate=0.0, muon_learning_rate=0.0)
    for count in (3, MANY_VIEWS):
        support = ball_views(ring(count))
        # rates of 0 lower no error
        made = ignoring_no_progress(lambda given=support: adapter.fine_tune(given, 1, still))
        one_step = adapter.adapt(support)
        assert torch.equal(made.field.parameters["grid.weight"], one_step.field.parameters["grid.weight"]) == (
            count == 3
        )


def test_pictures_are_not_averaged_without_a_field_before_the_steps():
    adapter, support = stepping(), ball_views(ring(4))
    assert isinstance(adapter.fine_tune(support, 1, FEW), AveragedField)
    assert not isinstance(adapter.fine_tune(ball_views(ring(MANY_VIEWS)), 1, FEW), AveragedField)
    assert not isinstance(adapter.fine_tune(support, 1, FineTuning("hypernetwork", rays=32)), AveragedField)
    assert not isinstance(FromScratch(adapter, 1, FEW).adapt(support), AveragedField)
    alone = HyperPlanes(adapter.config.target_alone())
    assert not isinstance(alone.fine_tune(support, 1, FEW), AveragedField)
    assert not isinstance(adapter.fine_tune(support, 0, FEW), AveragedField)
    assert not isinstance(adapter.fine_tune(support, 1, replace(FEW, fresh=0.5)), AveragedField)
    with pytest.raises(ValueError, match=r"average: expected 0 .* partly random .*\(fresh 0.5\), got 0.2"):
        adapter.fine_tune(ball_views(ring(MANY_VIEWS)), 1, replace(FEW, average=0.2))
    with pytest.raises(ValueError, match="average: expected a share"):
        FineTuning(average=1.5)


def test_reflections_are_not_counted_where_an_average_is_given():
    adapter, across = stepping(), Symmetry(Plane((1.0, 0.0, 0.0)))
    context = adapter.prepare(ball_views(ring(MANY_VIEWS - 4)), symmetry=across)
    assert len(context.views) > MANY_VIEWS
    assert fine_tune_to(adapter, context, 1, replace(FEW, average=0.3)).share == 0.3


@pytest.mark.parametrize("cells", [None, 40])
def test_saved_weights_of_one_object_contain_both_fields_of_the_average(cells, tmp_path):
    adapter, support = stepping(), ball_views(ring(3))
    tuned = adapter.fine_tune(support, 2, replace(FEW, cells=cells))
    adapter.with_weights_of(tuned).save(tmp_path)
    kept = HyperPlanes.from_pretrained(tmp_path)
    assert kept.config.average == 0.5
    assert_close(pictures(kept.adapt(support)), pictures(tuned), atol=1e-6, rtol=0)
    further = kept.fine_tune(support, 1, FEW)
    assert torch.equal(pictures(further.other), pictures(tuned.other))
    assert not torch.equal(pictures(further), pictures(tuned))
    assert further.share == 0.5


def test_the_best_number_of_steps_is_found_with_averaged_pictures(monkeypatch):
    monkeypatch.setattr(descent, "HOLDOUT_RAYS", 256)
    adapter, support = stepping(), ball_views(ring(9))
    shown, holdout = split_holdout(support, FEW)
    context = adapter.prepare(shown)
    views = trained_on(context, shown)
    beside = adapter.field(context, updated_weights(adapter, context))
    stops = [
        make_descent(adapter, context, replace(FEW, max_steps=6), views).best_stop(
            holdout, unchanged=beside, beside=beside, share=share
        )
        for share in (0.0, 1.0)
    ]
    assert stops[0] > stops[1] == 0  # with a share of 1, all numbers of steps give the same pictures
