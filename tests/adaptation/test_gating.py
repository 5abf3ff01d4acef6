"""Sources of truth: shares set by hand, means of pictures, and examples in which it is known which picture is right."""

import queue
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import CorrectedField, HullBlend, HyperPlanes
from hyperplanes.adaptation.correction.held_out import MIN_VIEWS
from hyperplanes.adaptation.correction.stacking import AveragedField, StackedField, stack
from hyperplanes.adaptation.fine_tuning import fine_tune_to
from hyperplanes.adaptation.gating import GatingNetwork, readings
from hyperplanes.adaptation.optimisation.descent import Descent
from hyperplanes.commands import view
from hyperplanes.commands.inputs.fields import adapt_to
from hyperplanes.commands.output.console import Console
from hyperplanes.configuration.fine_tuning import MANY_VIEWS, FineTuning
from hyperplanes.evaluation.suitability import held_out_psnr
from hyperplanes.geometry.rays import cast
from hyperplanes.geometry.symmetry.reflections import Plane, Symmetry
from hyperplanes.training import gating
from hyperplanes.training.gating import GatingExample, example_of, fit_gate, turned
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Task
from tests.adaptation.test_stacking import CONFIG, both, model
from tests.reference_rendering import ball_views, ring


def constant(share):
    """A gate that gives every pixel the same share."""
    gate = GatingNetwork()
    gate.layers[-1].weight.zero_()
    gate.layers[-1].bias.fill_(torch.logit(torch.tensor(share)))
    return gate


@pytest.mark.parametrize("by_object", [0.1, 0.95])  # with the second, densities are those of the hull
def test_a_gate_with_a_constant_share_gives_the_mean_with_that_share(by_object):
    learned, hull = both(ball_views(ring(6, (24, 24))))
    stacked, cameras = stack(learned, hull, by_object, constant(0.3), 6), ring(2, (10, 13), shift=1)
    one, other, mixed = (each.render(cameras) for each in (learned, hull, stacked))
    torch.testing.assert_close(mixed.images, torch.lerp(one.images, other.images, 0.3))
    torch.testing.assert_close(mixed.opacity, torch.lerp(one.opacity, other.opacity, 0.3))
    rays = cast(cameras, torch.zeros(5, dtype=torch.long), torch.rand(5, 2) * 4 + 4, learned.occupancy.bounds)
    one, other, mixed = (each.trace(rays, differentiable=False) for each in (learned, hull, stacked))
    torch.testing.assert_close(mixed.colour, torch.lerp(one.colour, other.colour, 0.3))
    torch.testing.assert_close(mixed.opacity, torch.lerp(one.opacity, other.opacity, 0.3))


def test_shares_are_computed_per_pixel():
    learned, hull = both(ball_views(ring(6, (24, 24))))
    cameras, gate = ring(2, (10, 13), shift=1), GatingNetwork()
    one, other = (each.render(cameras) for each in (learned, hull))
    found = gate.shares(one, other, 0.4, 6)
    assert found.shape == one.opacity.shape
    view, row, column = 1, 4, 6
    pixel = [each.images[view, :, row, column] for each in (one, other)]
    opacity = [each.opacity[view, 0, row, column] for each in (one, other)]
    expected = gate(readings(*pixel, *opacity, 0.4, 6))
    torch.testing.assert_close(found[view, 0, row, column], expected)
    assert found.std() > 0


def test_a_gate_in_double_precision_gives_the_same_shares():
    learned, hull = both(ball_views(ring(6, (24, 24))))
    cameras, gate = ring(2, (10, 13), shift=1), GatingNetwork()
    pictures = [each.render(cameras) for each in (learned, hull)]
    expected = gate.shares(*pictures, 0.4, 6)
    torch.testing.assert_close(gate.double().shares(*pictures, 0.4, 6), expected)


def test_pixels_are_gated_with_five_or_more_masked_views():
    adapter = HyperPlanes(replace(CONFIG, gated=True))
    for count in (MIN_VIEWS - 1, MIN_VIEWS):
        support = ball_views(ring(count, (24, 24)))
        assert isinstance(adapter.adapt(support), StackedField) == (count == MIN_VIEWS)
        with pytest.warns(UserWarning, match="the views have no alpha and no masks, but the model"):
            unmasked = adapter.adapt(replace(support, masks=None))
        assert not isinstance(unmasked, StackedField)


def test_a_command_reports_missing_masks_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HYPERPLANES_CACHE", str(tmp_path))
    views = replace(ball_views(ring(MIN_VIEWS, (24, 24))), masks=None)
    adapter = HyperPlanes(CONFIG)
    adapt_to(adapter, views, "ball", Console())  # a warning of the model itself would be an error
    held_out_psnr(adapter, views)
    assert "".join(capsys.readouterr()).count("no alpha and no masks") == 1


def test_fine_tuned_pictures_are_gated_with_ten_or_more_masked_views():
    """The share of the object, an input of the gate, is 0 for fine-tuned fields."""
    adapter, settings = HyperPlanes(replace(CONFIG, gated=True)), FineTuning(rays=8)
    cameras = ring(2, (10, 13), shift=1)
    adapter.gate.load_state_dict(constant(0.3).state_dict())
    for count in (MANY_VIEWS - 1, MANY_VIEWS):
        support = ball_views(ring(count, (24, 24)))
        tuned = adapter.fine_tune(support, 1, settings)
        with pytest.warns(UserWarning, match="no alpha and no masks"):
            unmasked = adapter.fine_tune(replace(support, masks=None), 1, settings)
        assert [isinstance(each, AveragedField) for each in (tuned, unmasked)] == [count < MANY_VIEWS] * 2
        assert isinstance(tuned, StackedField)
        assert isinstance(unmasked, StackedField) == (count < MANY_VIEWS)
    assert (tuned.share, tuned.views) == (0, MANY_VIEWS)
    again = adapter.with_weights_of(tuned).adapt(support)
    torch.testing.assert_close(again.render(cameras).images, tuned.render(cameras).images, atol=1e-6, rtol=0)
    adapter.config = replace(adapter.config, residuals=True)
    corrected = adapter.fine_tune(support, 1, settings)
    assert not isinstance(corrected.without_residuals(), StackedField)  # corrected pictures are not stacked
    assert not adapter.with_weights_of(corrected).config.gated
    assert isinstance(adapter.without_residuals().fine_tune(support, 1, settings), StackedField)
    few = adapter.prepare(ball_views(ring(MANY_VIEWS - 1, (24, 24))), symmetry=Symmetry(Plane((1.0, 0.0, 0.0))))
    assert len(few.views) > MANY_VIEWS
    assert isinstance(fine_tune_to(adapter, few, 1, settings), AveragedField)  # reflections do not count
    alone, hull = replace(tuned, gate=None), HullBlend().adapt_to(adapter.prepare(support).planes)
    one, other, mixed = (each.render(cameras).images for each in (alone, hull, tuned))
    torch.testing.assert_close(mixed, torch.lerp(one, other, 0.3))


@pytest.mark.parametrize(("steps", "count"), [(0, MANY_VIEWS), (1, MANY_VIEWS), (1, 3)])
def test_view_shows_the_same_pictures_as_render_without_residuals(tmp_path, steps, count):
    class Viewer:
        def show(self, field, _):
            self.field = field

    adapter, support, cameras = (
        HyperPlanes(replace(CONFIG, gated=True, residuals=True)).eval(),
        ball_views(ring(count, (24, 24))),
        ring(1),
    )
    arguments, viewer = view.Arguments(tmp_path, steps=steps, fit=0), Viewer()
    view._adapt(adapter, support, arguments, viewer, queue.SimpleQueue(), Console(silent=True))
    made = adapter.without_residuals().fine_tune(support, steps)
    torch.testing.assert_close(viewer.field.render(cameras).images, made.render(cameras).images)
    assert isinstance(made, StackedField)  # stacked with the hull, or averaged with the field before the steps
    assert not isinstance(viewer.field, CorrectedField)


def test_view_fine_tunes_on_the_same_views_as_render_and_its_fields_do_not_change(tmp_path, monkeypatch):
    class Viewer:
        fields, pictures = [], []

        def show(self, field, _):
            self.fields.append(field)
            self.pictures.append(field.render(cameras).images)

    adapter, support, cameras, descents = HyperPlanes(CONFIG).eval(), ball_views(ring(8, (24, 24))), ring(1), []
    adapter.config = replace(adapter.config, symmetry=Symmetry(Plane((1.0, 0.0, 0.0)), 2, (0.0, 0.0, 0.0)))
    run = Descent.run
    monkeypatch.setattr(Descent, "run", lambda self, steps: descents.append(self) or run(self, steps))
    monkeypatch.setattr(view, "EVERY", 1)
    arguments, viewer = view.Arguments(tmp_path, steps=2, fit=0), Viewer()
    view._adapt(adapter, support, arguments, viewer, queue.SimpleQueue(), Console(silent=True))
    adapter.fine_tune(support, 2)
    assert len(descents[0].views) == len(descents[1].views)
    assert len(viewer.fields) == 3
    for field, picture in zip(viewer.fields, viewer.pictures, strict=True):
        assert torch.equal(field.render(cameras).images, picture)
    assert not torch.equal(*viewer.pictures[:2])


def test_a_fitted_gate_chooses_the_right_picture(monkeypatch):
    # Two pictures of noise: the first is right where its opacity is 1, the second where it is below a half.
    monkeypatch.setattr(gating, "EXAMPLES_PER_STEP", 4)
    monkeypatch.setattr(gating, "PIXELS_PER_EXAMPLE", 256)
    generator = torch.Generator().manual_seed(0)
    examples = []
    for _ in range(2):
        truth, wrong = torch.rand(2, 4000, 3, generator=generator)
        opacity = torch.where(torch.rand(4000, generator=generator) < 0.5, 1.0, 0.4)
        first = torch.where(opacity[:, None] == 1, truth, wrong)
        second = torch.where(opacity[:, None] == 1, wrong, truth)
        read = readings(first, second, opacity, torch.ones(4000), 0.2, 10)
        examples.append(GatingExample(read, first, second, truth, float((first - truth).square().sum())))
    gate = fit_gate(examples, steps=300)
    shares = gate(examples[0].read)
    assert float(shares[opacity_of(examples[0]) == 1].mean()) < 0.05
    assert float(shares[opacity_of(examples[0]) < 1].mean()) > 0.95
    assert not any(each.requires_grad for each in gate.parameters())
    one, other = (fit_gate(examples, steps=2).state_dict() for _ in range(2))
    assert all(torch.equal(one[name], other[name]) for name in one)
    nothing = GatingExample(*(each[:0] for each in (examples[0].read, *[torch.zeros(0, 3)] * 3)), 1.0)
    with_nothing = fit_gate([nothing, *examples], steps=2).state_dict()
    assert all(torch.equal(one[name], with_nothing[name]) for name in one)
    for unusable in ([], [nothing]):
        with pytest.raises(ValueError, match="examples: expected at least one example with a pixel"):
            fit_gate(unusable)


def opacity_of(example):
    return example.read[:, 1]


def test_an_example_contains_the_pixels_that_are_not_empty_in_both_pictures():
    adapter, task = model(), Task(ball_views(ring(6, (24, 24))), ball_views(ring(2, (10, 13), shift=1)), "ball")
    found = example_of(adapter, task)
    context = adapter.prepare(task.support)
    learned = adapter.rendering_field(context, adapter.adapted_weights(context)).render(task.query.cameras)
    hull = HullBlend().adapt_to(context.planes).render(task.query.cameras)
    some = ((learned.opacity > 0) | (hull.opacity > 0))[:, 0]
    torch.testing.assert_close(found.truth, task.query.images.movedim(1, -1)[some])
    torch.testing.assert_close(found.hull, hull.images.movedim(1, -1)[some])
    assert found.error == pytest.approx(float((learned.images - task.query.images).square().sum()), rel=1e-4)


def test_a_rotated_task_shows_the_same_object():
    task = Task(ball_views(ring(6, (24, 24))), ball_views(ring(2, (24, 24), shift=1)), "ball")
    moved = turned(task, torch.Generator().manual_seed(0))
    one, other = (HullBlend().adapt(each.support).render(each.query.cameras).images for each in (task, moved))
    assert not torch.equal(moved.support.cameras.extrinsics, task.support.cameras.extrinsics)
    assert float(psnr(other, one).min()) > 25  # differences come from the voxels of the hull, which are not rotated
