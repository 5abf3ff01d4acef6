"""Sources of truth: a textured ball whose depth is known, and examples in which it is known what has to be added."""

import math
from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import CorrectedField, HyperPlanes, ResidualField, correction_network
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.correction import residuals
from hyperplanes.adaptation.correction.residuals import MIN_CROSS_VALIDATED_VIEWS, MIN_SHARE, SHARE_FACTOR
from hyperplanes.adaptation.correction_network import (
    CANDIDATES,
    COLOUR,
    DEPTH_OFFSETS,
    DEVIATIONS,
    INITIAL_WEIGHTS,
    MIN_CORRECTED_OPACITY,
    OPACITY,
    READINGS,
    CorrectionNetwork,
)
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering import RayMarching
from hyperplanes.training.correction import (
    CorrectionExample,
    _with_random_colours,
    disturbed,
    example_of,
    fit_correction,
    recoloured,
)
from hyperplanes.views import Views
from tests.adaptation import test_stacking
from tests.reference_rendering import Balls, ball_views, camera_at, ring

SIZE = (48, 48)


def striped(radius, contrast=0.4):
    """An opaque ball with stripes, which are the same at all depths."""

    def field(points, directions):
        along = torch.nn.functional.normalize(points, dim=-1)
        stripes = 0.5 + contrast * torch.sin(15 * along[:, :1] + along.new_tensor([0.0, 1.0, 2.0])) * torch.cos(
            6 * along[:, 1:2]
        )
        return stripes, 400.0 * (points.norm(dim=-1) < radius)

    return AdaptedField(field, full(Sphere(), 32), RayMarching(96, 0.02))


def views_of(field, cameras):
    return Views(field.render(cameras).images, cameras, None, Sphere())


@pytest.fixture(scope="module")
def deep():
    """A grey ball that is too small by one depth offset, and views of the striped ball that it should be."""
    aside = [math.radians(degrees) for degrees in (20, 30, 40, 50)]  # all on one side, so that errors do not cancel
    cameras = camera.concatenate([camera_at((3 * math.sin(each), 0.0, 3 * math.cos(each)), SIZE) for each in aside])
    support, asked = views_of(striped(0.6), cameras), camera_at((0.0, 0.0, 3.0), SIZE)
    return striped(0.6 + DEPTH_OFFSETS[1], 0.0), support, views_of(striped(0.6), asked)


def learned(seed=0):
    """A network with random weights."""
    network = CorrectionNetwork()
    generator = torch.Generator().manual_seed(seed)
    for weights in network.parameters():
        weights.copy_(0.1 * torch.randn(weights.shape, generator=generator))
    return network


def test_residuals_from_the_depth_where_support_views_agree_are_better_if_the_surface_is_wrong(deep):
    wrong, support, query = deep
    inside = torch.zeros(SIZE, dtype=torch.bool)
    inside[20:28, 20:28] = True  # where the surface is hardly inclined
    errors = [
        (ResidualField(wrong, support, network).render(query.cameras).images - query.images)[0, :, inside]
        .square()
        .mean()
        for network in (None, CorrectionNetwork())
    ]
    assert errors[1] < 0.7 * errors[0]
    true = striped(0.6, 0.0)
    read = ResidualField(true, support).readings(true.render(query.cameras), query.cameras, 0)[CANDIDATES, inside]
    assert (read[:3] - read[3:6]).abs().mean() < 0.02


def test_an_untrained_network_adds_the_residuals_at_the_best_depths(deep):
    wrong, support, query = deep
    pictures, residuals = wrong.render(query.cameras), ResidualField(wrong, support, CorrectionNetwork())
    read = residuals.readings(pictures, query.cameras, 0)
    expected = pictures.images[0] + read[CANDIDATES][3:6] * (read[OPACITY] > MIN_CORRECTED_OPACITY)
    torch.testing.assert_close(residuals.correct(pictures, query.cameras).images[0], expected.clamp(0, 1))


def test_the_first_candidate_is_the_correction_without_a_network(deep):
    wrong, support, query = deep
    pictures, residuals = wrong.render(query.cameras), ResidualField(wrong, support)
    read = residuals.readings(pictures, query.cameras, 0)
    expected = (pictures.images[0] + read[CANDIDATES][:3]).clamp(0, 1)
    torch.testing.assert_close(residuals.correct(pictures, query.cameras).images[0], expected, atol=1e-5, rtol=0)


def test_only_the_rectangle_around_the_object_is_computed(monkeypatch):
    """It gives what the whole picture gives, also for several pictures at once."""
    read = torch.rand(2, READINGS, 40, 50, generator=torch.Generator().manual_seed(0))
    read[:, OPACITY] = 0.0
    read[0, OPACITY, 15:20, 20:28], read[1, OPACITY, 17:22, 0:9] = 0.6, 0.3
    network = learned()
    found = network(read)
    assert torch.equal(found[:, :, :15], torch.zeros(2, 3, 15, 50))
    monkeypatch.setattr(correction_network, "_box", lambda seen: (slice(None), slice(None)))
    torch.testing.assert_close(found, network(read))
    assert found[0, :, 15:20, 20:28].abs().min() > 0


def test_pictures_that_no_support_view_shows_stay(deep):
    wrong, support, query = deep
    behind = camera.look_at(-camera.centres(query.cameras).float(), (0.0, 0.0, 0.0))
    other_side = views_of(striped(0.6), camera.pinhole(camera.symmetric_intrinsics(*SIZE, 0.8), behind, *SIZE))
    away = camera_at((0.0, 0.0, 3.0), SIZE, target=(0.0, 0.0, 9.0))
    for cameras, views in ((away, support), (query.cameras, other_side)):
        residuals, plain = ResidualField(wrong, views, learned()), wrong.render(cameras)
        assert residuals.readings(plain, cameras, 0) is None
        assert torch.equal(residuals.correct(plain, cameras).images, plain.images.clamp(0, 1))


def multiplied(factor):
    """A network whose output is `factor` times the mean residual."""
    network = CorrectionNetwork()
    network.last[1].bias[:2] = torch.tensor([factor, -INITIAL_WEIGHTS[1]])
    return network


@pytest.fixture(scope="module")
def around():
    """A fine-tuned field, a striped ball that is too small, and views of the right one from all around."""
    return replace(striped(0.58, 0.2), fine_tuned=True), views_of(striped(0.6), ring(14, (32, 32)))


@pytest.mark.parametrize(("count", "factor"), [(14, 4.0), (14, 5.0), (14, 2.0), (14, 10.0), (6, 4.0), (6, 5.0)])
def test_the_share_of_a_network_is_the_best_for_support_views_that_are_left_out(around, monkeypatch, count, factor):
    """The others are corrected by a field of their own, which has never had the view that is left out."""
    monkeypatch.setattr(residuals, "LEFT_OUT_VIEWS", 5)
    field, support, chosen = around[0], around[1][:count], multiplied(factor)
    cross_validated, product, square = ResidualField(field, support, chosen), 0.0, 0.0
    for view in {14: (0, 3, 6, 9, 13), 6: (0, 1, 2, 3, 5)}[count]:
        others, own = support[[each for each in range(count) if each != view]], support[[view]]
        plain = field.render(own.cameras)
        corrections = ResidualField(field, others), ResidualField(replace(field, fine_tuned=False), others, chosen)
        mean, found = (each.correct(plain, own.cameras).images for each in corrections)
        product += float(((own.images - mean) * (found - mean)).sum())
        square += float((found - mean).square().sum())
        read = cross_validated.readings(plain, own.cameras, 0, without=view)
        torch.testing.assert_close(read, corrections[0].readings(plain, own.cameras, 0))
    expected = min(1.0, max(MIN_SHARE, SHARE_FACTOR * product / square))
    assert cross_validated.network_share() == pytest.approx(expected, abs=2e-3)
    asked = camera_at((0.0, 0.5, 3.0), (32, 32))
    of_forward_pass = ResidualField(replace(field, fine_tuned=False), support, chosen)
    mean, alone, both = (
        each.render(asked).images for each in (ResidualField(field, support), of_forward_pass, cross_validated)
    )
    unclamped = (mean > 0) & (mean < 1) & (alone > 0) & (alone < 1)
    torch.testing.assert_close(both[unclamped], torch.lerp(mean, alone, expected)[unclamped], atol=2e-3, rtol=0)


def test_few_views_are_not_cross_validated_and_neither_are_other_fields(around):
    field, support = around[0], around[1][:MIN_CROSS_VALIDATED_VIEWS]
    wrong = multiplied(40.0)
    assert ResidualField(field, support, wrong).network_share() == MIN_SHARE
    for other in (
        ResidualField(field, support[:-1], wrong),
        ResidualField(replace(field, fine_tuned=False), support, wrong),
        ResidualField(field, support),
    ):
        assert other.network_share() == 1


@pytest.fixture(scope="module")
def model():
    """A model whose correction network has random weights."""
    config = replace(test_stacking.CONFIG, stacked=False, residuals=True, learned_correction=True)
    made = HyperPlanes(config)
    made.load_state_dict(test_stacking.model().state_dict(), strict=False)
    made.corrector = learned()
    return made.eval()


@pytest.fixture(scope="module")
def many():
    return ball_views(ring(6, (24, 24)))


def test_a_model_corrects_its_pictures_by_its_network(model, many, tmp_path):
    asked = ring(2, (24, 24), shift=1)
    field = model.adapt(many)
    assert isinstance(field, CorrectedField)
    found, plain = field.render(asked).images, field.without_residuals()
    assert torch.equal(found, ResidualField(plain, many, model.corrector).render(asked).images)
    assert not torch.equal(found, ResidualField(plain, many).render(asked).images)
    alone = model.with_weights_of(field)
    torch.testing.assert_close(alone.adapt(many).render(asked).images, found)
    model.save(tmp_path / "saved")
    torch.testing.assert_close(HyperPlanes.from_pretrained(tmp_path / "saved").adapt(many).render(asked).images, found)
    without = model.without_residuals()
    without.save(tmp_path / "without")
    assert HyperPlanes.from_pretrained(tmp_path / "without").corrector is None
    assert model.corrector is not None
    assert model.double().adapt(many).render(asked).images.isfinite().all()
    model.float()


def test_a_fine_tuned_field_is_cross_validated_and_so_are_its_weights_alone(model, tmp_path):
    many, settings, model = ball_views(ring(14, (24, 24))), FineTuning(rays=32), deepcopy(model)
    model.corrector = multiplied(16.0)
    tuned = model.fine_tune(many, 2, settings)
    share = tuned.residuals.network_share()
    assert MIN_SHARE < share < 1
    model.with_weights_of(tuned).save(tmp_path)
    alone = HyperPlanes.from_pretrained(tmp_path)
    assert alone.adapt(many).residuals.network_share() == pytest.approx(share, abs=1e-3)
    assert alone.with_weights_of(alone.adapt(many)).config.fine_tuned
    unchanged = model.fine_tune(many, 0, settings)
    assert unchanged.residuals.network_share() == 1
    assert not model.with_weights_of(unchanged).config.fine_tuned
    # also where pictures are not corrected, as those of large views
    uncorrected = model.without_residuals()
    assert uncorrected.with_weights_of(uncorrected.fine_tune(many, 2, settings)).config.fine_tuned
    assert uncorrected.with_weights_of(tuned).config.fine_tuned


def test_a_correction_network_without_residuals_is_refused():
    with pytest.raises(ValueError, match="learned_correction: expected residuals"):
        HyperPlanes(replace(test_stacking.CONFIG, learned_correction=True))


def test_training_finds_which_candidate_is_right_and_where():
    """In nearly transparent pixels the third candidate is right, in opaque ones a quarter of the second."""
    generator = torch.Generator().manual_seed(0)

    def example():
        read = 0.2 * torch.randn(2, READINGS, 16, 16, generator=generator)
        faint = (torch.rand(2, 1, 16, 16, generator=generator) < 0.5).float()
        read[:, OPACITY] = 1 - 0.9 * faint
        added = faint * read[:, 9:12] + (1 - faint) * read[:, 6:9] / 4
        return CorrectionExample(read.half(), read[:, :3] + 0.5 + added)

    gains = []
    network = fit_correction([example() for _ in range(8)], steps=150, on_step=lambda _, gain: gains.append(gain))
    assert gains[-1] > gains[0] + 10
    test = example()
    error = (test.read[:, :3].float() + 0.5 + network(test.read.float()) - test.truth).square().mean().sqrt()
    assert error < 0.03
    assert not any(weights.requires_grad for weights in network.parameters())


def test_recoloured_pictures_have_recoloured_candidates_and_errors():
    """If a candidate is the error of a picture, it is that of the recoloured one; white stays white."""
    generator = torch.Generator().manual_seed(0)
    read, found = torch.rand(READINGS, 8, 8, generator=generator), set()
    read[COLOUR, :, :4] = 0.5  # white
    truth = read[COLOUR] + 0.5 + read[CANDIDATES][3:6]
    for _ in range(20):
        recoloured_read, recoloured_truth = _with_random_colours(read, truth, generator)
        plain = recoloured_read[0, COLOUR] + 0.5
        torch.testing.assert_close(plain + recoloured_read[0, CANDIDATES][3:6], recoloured_truth[0])
        assert (plain[:, :, :4] == 1).all()
        contrast = (recoloured_read[0, CANDIDATES][3:6].square().sum() / read[CANDIDATES][3:6].square().sum()).sqrt()
        deviations = recoloured_read[0, DEVIATIONS] / read[DEVIATIONS]
        torch.testing.assert_close(deviations, contrast.expand_as(deviations), atol=0.05, rtol=0)
        found.add(round(float(contrast), 3))
        assert torch.equal(recoloured_read[0, OPACITY], read[OPACITY])
    assert len(found) > 10
    assert 0.49 < min(found) < max(found) < 1


def test_examples_are_the_readings_of_the_query_views(model):
    task = Balls(views=6, size=(24, 24)).task("train0")
    example = example_of(model, task)
    assert example.read.shape == (len(task.query), READINGS, 24, 24)
    assert torch.equal(example.truth, task.query.images)
    pictures = model.adapt(task.support).without_residuals().render(task.query.cameras)
    torch.testing.assert_close(example.read[:, :3].float(), pictures.images - 0.5, atol=1e-3, rtol=0)
    tuned = example_of(model, task, 2)
    assert not torch.equal(tuned.read, example.read)
    with pytest.raises(ValueError, match="expected at least one"):
        fit_correction([])


def test_disturbed_cameras_are_rotated_by_the_angle_and_moved(many):
    found = disturbed(many, 2.0, torch.Generator().manual_seed(0))
    before, after = (each.cameras.rotation_matrix.double() for each in (many, found))
    cosines = ((before @ after.mT).diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    torch.testing.assert_close(cosines.acos().rad2deg(), torch.full((6,), 2.0).double(), atol=1e-2, rtol=0)
    moved = found.cameras.translation_vector - after.to(before) @ before.mT @ many.cameras.translation_vector.double()
    assert 0.01 < float(moved.norm(dim=1).mean()) < 0.12
    assert torch.equal(found.images, many.images)


def test_recoloured_views_have_other_exposures_and_the_same_background(many):
    """The logarithm of the ratio of colours has the variance of exposure, white balance and noise, 1 + 1/9 and more."""
    masks = torch.zeros(len(many), 1, *many.size)
    masks[..., 4:20, 4:20] = 1.0
    grey = replace(many, images=1 - masks.expand(-1, 3, -1, -1) / 2, masks=masks)
    generator = torch.Generator().manual_seed(0)
    ratios = []
    for _ in range(100):
        found = recoloured(grey, 0.1, generator)
        assert torch.equal(found.images[..., :4, :], grey.images[..., :4, :])
        assert torch.equal(found.masks, masks)
        ratios.append((found.images[..., 4:20, 4:20] / 0.5).log().mean((2, 3)))
    spread = torch.cat(ratios)
    assert 0.095 < float(spread.std()) < 0.115
    between = (spread - spread.mean(1, keepdim=True)).square().sum(1).mean().div(2).sqrt()
    assert 0.03 < float(between) < 0.037
    with pytest.raises(ValueError, match="views: expected masks"):
        recoloured(replace(many, masks=None), 0.1, generator)
