"""Sources of truth: a loop over pixels and support views, and a ball in closed form."""

import copy
import math
from dataclasses import replace
from itertools import pairwise
from math import cos, sin
from threading import Thread

import pytest
import torch

from hyperplanes.adaptation import (
    CorrectedField,
    HullBlend,
    HyperPlanes,
    ResidualField,
    correction_network,
    reprojection,
)
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.correction import residuals
from hyperplanes.adaptation.fine_tuned import FineTuned, FromScratch
from hyperplanes.adaptation.optimisation.descent import Descent
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.commands.inputs.disk_cache import keep_field, recall_field
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere, cast
from hyperplanes.methods import Unchecked
from hyperplanes.rendering import RayMarching
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views
from tests.adaptation import test_stacking
from tests.reference_rendering import ball_views, camera_at, ring

SIZE = (24, 24)


def ball(colour, radius=0.5):
    """An opaque ball of one colour."""

    def field(points, directions):
        return points.new_tensor(colour).expand_as(points), 400.0 * (points.norm(dim=-1) < radius)

    return AdaptedField(field, full(Sphere(), 24), RayMarching(96, 0.02))


def towards(one):
    """The direction of a camera from the centre of the scene."""
    return camera.camera_directions(one, (0.0, 0.0, 0.0))[0].float()


class Counting:
    """A field that counts the rendered pictures."""

    def __init__(self, field):
        self.field, self.rendered = field, 0

    def render(self, cameras):
        self.rendered += cameras.batch_size
        return self.field.render(cameras)


@pytest.fixture(scope="module")
def support():
    return ball_views(ring(24, SIZE))


@pytest.fixture(scope="module")
def query():
    return ball_views(ring(6, SIZE, shift=1))[::2]


def test_residuals_correct_a_wrong_colour_and_those_of_wrong_views_do_not(support, query):
    grey = ball((0.5, 0.5, 0.5))
    plain, corrected = (
        float(psnr(each.render(query.cameras).images, query.images).mean())
        for each in (grey, ResidualField(grey, support))
    )
    assert corrected > plain + 3
    order = torch.randperm(24, generator=torch.Generator().manual_seed(0)).tolist()
    shuffled = Views(support.images[order], support.cameras, support.masks, support.bounds)
    upside_down = Views(support.images.flip(2), support.cameras, support.masks, support.bounds)
    for wrong in (shuffled, upside_down):
        assert psnr(ResidualField(grey, wrong).render(query.cameras).images, query.images).mean() < corrected - 0.5


def test_residuals_of_a_field_that_matches_the_views_are_zero(query):
    grey = ball((0.5, 0.5, 0.5))
    cameras = ring(6, SIZE)
    views = Views(grey.render(cameras).images, cameras, None, Sphere())
    torch.testing.assert_close(
        ResidualField(grey, views).render(query.cameras).images, grey.render(query.cameras).images, atol=1e-6, rtol=0
    )


def scene(name):
    """A field, its support views and a new camera."""
    if name == "ball":
        return ball((0.5, 0.5, 0.5)), ball_views(ring(24, SIZE)), camera_at((0.4, 0.8, 2.9), SIZE)
    # fog away from the origin, and support views so near that each shows only a part
    centre, bounds = (3.0, -2.0, 1.0), Sphere((3.0, -2.0, 1.0), 2.0)

    def mist(points, directions):
        away = (points - points.new_tensor(centre)).norm(dim=-1)
        return torch.full_like(points, 0.5), 0.12 * (away < 1.2)

    there = torch.eye(4)
    there[:3, 3] = torch.tensor(centre)
    near, asked = (camera.moved(each, there) for each in (ring(24, SIZE, angle=0.4), camera_at((0.5, 1.5, 5.8), SIZE)))
    images = 0.3 * torch.rand(24, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    return AdaptedField(mist, full(bounds, 24), RayMarching(96, 0.0)), Views(images, near, None, bounds), asked


@pytest.mark.parametrize(("name", "most"), [("ball", 8), ("ball", 2), ("mist", 8)])
def test_corrected_pixels_agree_with_a_loop_over_the_nearest_views(name, most, monkeypatch):
    monkeypatch.setattr(reprojection, "MAX_VIEWS", most)
    field, support, asked = scene(name)
    plain, found = field.render(asked), ResidualField(field, support).render(asked).images[0]
    own, faint, outside, changed = field.render(support.cameras), 0, 0, 0
    for row, column in (
        (plain.opacity[0, 0] > correction_network.MIN_CORRECTED_OPACITY)
        .nonzero()
        .tolist()[:: 9 if name == "ball" else 6]
    ):
        depth, opacity = (float(each[0, 0, row, column]) for each in (plain.depth, plain.opacity))
        if not depth:
            continue
        ray = cast(asked, torch.tensor([0]), torch.tensor([[column, row]]), support.bounds)
        point = ray.origins[0] + depth * ray.directions[0]
        total, weights = torch.zeros(3), reprojection.DOUBT
        offsets = point - camera.centres(support.cameras).to(point)
        asides = 1 - offsets @ ray.directions[0].to(offsets) / offsets.norm(dim=1)
        for view in asides.argsort()[:most].tolist():
            one, offset, aside = camera.select(support.cameras, [view]), offsets[view], float(asides[view])
            x, y = one.project(point[None].to(one.extrinsics))[0].tolist()
            if aside >= reprojection.MAX_COSINE_DISTANCE:
                continue
            if not (0 <= x <= SIZE[1] - 1 and 0 <= y <= SIZE[0] - 1):
                outside += 1
                continue
            left, top = min(math.floor(x), SIZE[1] - 2), min(math.floor(y), SIZE[0] - 2)
            share = {
                (top + j, left + i): abs(1 - i - (x - left)) * abs(1 - j - (y - top)) for i in (0, 1) for j in (0, 1)
            }
            lacking, moment, covered = torch.zeros(3), 0.0, 0.0
            for (at, along), part in share.items():
                lacking += part * (support.images - own.images)[view, :, at, along]
                moment += part * float(own.depth[view, 0, at, along] * own.opacity[view, 0, at, along])
                covered += part * float(own.opacity[view, 0, at, along])
            apart = (float(offset.norm()) - moment / max(covered, 1e-3)) / (
                reprojection.DISTANCE_SCALE * support.bounds.radius
            )
            angular = math.exp(-reprojection.ANGULAR_FALLOFF * aside) - math.exp(
                -reprojection.ANGULAR_FALLOFF * reprojection.MAX_COSINE_DISTANCE
            )
            weight = angular * math.exp(-(apart**2))
            total, weights = total + weight * lacking, weights + weight
        expected = (
            plain.images[0, :, row, column]
            + min(1, opacity / correction_network.FULL_CORRECTION_OPACITY) * total / weights
        )
        torch.testing.assert_close(found[:, row, column], expected.clamp(0, 1), atol=1e-3, rtol=0)
        changed += bool((expected - plain.images[0, :, row, column]).abs().max() > 0.05)
        faint += opacity < 0.8 * correction_network.FULL_CORRECTION_OPACITY
    assert changed > 5
    assert name == "ball" or (faint > 5 and outside > 5)


def test_views_in_which_a_point_is_occluded_add_no_residuals():
    # In the only view, a large ball occludes a small one, so that its residuals do not belong to the small one.
    def two(points, directions):
        near, far = points.norm(dim=-1) < 0.3, (points - points.new_tensor([0.0, 0.0, -0.8])).norm(dim=-1) < 0.15
        return torch.full_like(points, 0.5), 400.0 * (near | far)

    field = AdaptedField(two, full(Sphere(), 32), RayMarching(96, 0.02))
    front, aside = camera_at((0.0, 0.0, 3.0), (48, 48)), camera_at((2.2, 0.0, 2.0), (48, 48))
    plain = field.render(aside)
    view = Views(1 - field.render(front).images, front, None, Sphere())  # large residuals
    added = (ResidualField(field, view).render(aside).images - plain.images).abs().sum(1)[0]
    small = plain.depth[0, 0] > 3.2
    assert small.sum() > 10
    assert added[small].max() < 0.01 < added.max()


def test_only_views_from_the_same_side_are_rendered_and_each_only_once(support):
    counting = Counting(ball((0.5, 0.5, 0.5)))
    corrected = ResidualField(counting, support)
    asked = camera_at((0.0, 0.0, 3.0), SIZE)
    near = int((support.camera_directions @ towards(asked) > 0.5).sum())  # views from the same side
    first = corrected.render(asked).images
    rendered = counting.rendered - 1
    assert near <= rendered <= near + 2 < 16
    assert torch.equal(corrected.render(asked).images, first)
    assert counting.rendered == 2 + rendered
    done = []
    corrected.prepare(done.append)
    assert done == list(range(1, 25))
    assert counting.rendered == 2 + 24
    corrected.render(ring(24, SIZE))
    assert counting.rendered == 2 + 24 + 24


def test_corrected_pictures_do_not_depend_on_pictures_before():
    """Near cameras on one side, far ones on the other: in one call, the near ones give the far ones more samples."""
    angles = [0.1 * place for place in range(-3, 4)]
    eyes = [[(3 * sin(a), 0.2, 3 * cos(a)), (9 * sin(a), 0.2, -9 * cos(a))] for a in angles]
    size = (96, 96)
    support = ball_views(camera.concatenate([camera_at(eye, size) for pair in eyes for eye in pair]))
    coarse, asked = replace(ball((0.5, 0.5, 0.5)), sampling=RayMarching(6)), camera_at((0.5, 0.0, -3.0), size)
    expected = ResidualField(coarse, support).render(asked).images
    prepared = ResidualField(coarse, support)
    prepared.prepare()
    assert torch.equal(prepared.render(asked).images, expected)


def test_pictures_are_corrected_independently_and_opacity_and_depth_do_not_change(support, query):
    grey = ball((0.5, 0.5, 0.5))
    corrected, plain = ResidualField(grey, support), grey.render(query.cameras)
    together = corrected.render(query.cameras)
    assert torch.equal(together.opacity, plain.opacity)
    assert torch.equal(together.depth, plain.depth)
    assert float(together.images.min()) >= 0 <= float(together.images.max()) <= 1
    for view in range(len(query)):
        alone = ResidualField(grey, support).render(camera.select(query.cameras, [view])).images[0]
        torch.testing.assert_close(together.images[view], alone, atol=1e-5, rtol=0)


def test_the_weight_of_a_view_decreases_continuously_to_zero():
    field = ball((0.5, 0.5, 0.5))
    support = ball_views(camera_at((0.0, 0.0, 3.0), SIZE))
    added = []
    for degrees in (30, 50, 58, 59.5, 60.5, 62, 70, 85):
        asked = camera_at((3 * math.sin(math.radians(degrees)), 0.0, 3 * math.cos(math.radians(degrees))), SIZE)
        plain = field.render(asked).images
        added.append(float((ResidualField(field, support).render(asked).images - plain).abs().max()))
    assert added[0] > 0.1
    assert added == sorted(added, reverse=True)
    assert all(before - after < 0.02 for before, after in pairwise(added[2:6]))
    assert added[-1] < 1e-6


def test_empty_pictures_are_not_corrected(support):
    away = camera_at((0.0, 0.0, 3.0), SIZE, target=(0.0, 0.0, 9.0))
    assert torch.equal(ResidualField(ball((0.5, 0.5, 0.5)), support).render(away).images, torch.ones(1, 3, *SIZE))


def test_a_copy_is_independent(support, query):
    corrected = ResidualField(ball((0.5, 0.5, 0.5)), support)
    first = corrected.render(query.cameras).images
    again = copy.deepcopy(corrected)
    assert torch.equal(again.render(query.cameras).images, first)


def test_views_from_the_other_side_add_no_residuals():
    back = ball_views(camera_at((0.0, 0.0, -3.0), SIZE))
    grey, asked = ball((0.5, 0.5, 0.5)), camera_at((0.0, 0.0, 3.0), SIZE)
    assert torch.equal(ResidualField(grey, back).render(asked).images, grey.render(asked).images.clamp(0, 1))


def test_a_corrected_field_can_be_corrected_again(support, query):
    """In a separate thread, so that a deadlock does not block the tests."""
    found = []
    again = ResidualField(ResidualField(ball((0.5, 0.5, 0.5)), support), support)
    thread = Thread(target=lambda: found.append(again.render(query.cameras)), daemon=True)
    thread.start()
    thread.join(30)
    assert len(found) == 1


def model(**settings):
    """A model with residual correction."""
    made = HyperPlanes(replace(test_stacking.CONFIG, stacked=False, residuals=True, **settings))
    made.load_state_dict(test_stacking.model().state_dict(), strict=False)
    return made.eval()


@pytest.fixture(scope="module")
def many():
    """More views than residual correction needs."""
    return ball_views(ring(6, SIZE))


@pytest.mark.parametrize("azimuth", [0.0, 0.7])
def test_a_model_corrects_the_pictures_of_its_fields(many, query, azimuth):
    field = model(azimuth=azimuth).adapt(many)
    plain = field.without_residuals()
    found = field.render(query.cameras).images
    torch.testing.assert_close(found, ResidualField(plain, many).render(query.cameras).images)
    assert (found - plain.render(query.cameras).images).abs().max() > 0.02
    for options in ({"sampling": RayMarching(12)}, {"antialias": False}):
        assert torch.equal(field.render(query.cameras, **options).images, plain.render(query.cameras, **options).images)
    assert torch.equal(field.render(query.cameras, antialias=True).images, found)
    assert torch.equal(field.with_sampling(field.sampling).render(query.cameras).images, found)
    rays, _, _ = query.rays_at(torch.arange(40))
    assert torch.equal(field.trace(rays).colour, plain.trace(rays).colour)
    assert not isinstance(field.with_sampling(RayMarching(12)), CorrectedField)


@pytest.mark.parametrize("name", ["hull_blend", "stacked", "rotated"])
def test_a_view_with_a_penalty_is_hardly_read_for_its_own_picture(many, name):
    """Views of noise, so that it shows which of them a picture comes from."""
    noise = torch.rand(many.images.shape, generator=torch.Generator().manual_seed(0))
    views = replace(many, images=torch.where(many.masks > 0.5, noise, many.images))
    made = {"stacked": test_stacking.model(), "rotated": model(azimuth=0.7).without_residuals()}
    field = HullBlend().adapt(views) if name == "hull_blend" else made[name].adapt(views)
    penalised = field.with_penalty_at(camera.centres(views.cameras)[3], 1.0)
    one = camera.select(views.cameras, [3])
    for own, other in ((field, penalised), *([(field.other, penalised.other)] if name == "stacked" else [])):
        errors = [(each.render(one).images - views.images[[3]]).square().mean() for each in (own, other)]
        assert errors[1] > 1.3 * errors[0]
    points = 0.6 * torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) - 0.3
    assert torch.equal(penalised.density(points), field.density(points))


def test_only_views_from_the_place_get_the_penalty_and_fields_that_choose_no_views_stay(many):
    field, (one, other) = HullBlend().adapt(many), camera.centres(many.cameras)[:2]

    def penalties(adapted):
        seen = adapted.field.planes.choose(torch.zeros(1, 3), best=len(many)).best
        return seen.penalty[0, seen.views[0].argsort()]

    added = penalties(field.with_penalty_at(one, 0.5)) - penalties(field)
    torch.testing.assert_close(added, 0.5 * torch.eye(len(many))[0])
    between = field.with_penalty_at((one + other) / 2, 0.5)
    assert torch.equal(penalties(between), penalties(field))
    grey = ball((0.5, 0.5, 0.5))
    assert grey.with_penalty_at(one, 0.5) is grey


def test_a_model_without_residuals_is_another_one_with_the_same_weights(many):
    corrected = model()
    plain = corrected.without_residuals().without_reflections()
    assert not isinstance(plain.adapt(many), CorrectedField)
    assert isinstance(corrected.adapt(many), CorrectedField)
    assert all(own is other for own, other in zip(plain.parameters(), corrected.parameters(), strict=True))
    plain.hypernetwork = None
    assert corrected.hypernetwork is not None


@pytest.mark.filterwarnings("ignore:the views have no alpha and no masks")
def test_pictures_of_few_or_large_views_or_without_masks_are_not_corrected(many, monkeypatch):
    assert isinstance(model().adapt(many[: residuals.MIN_CORRECTED_VIEWS]), CorrectedField)
    for others in (many[: residuals.MIN_CORRECTED_VIEWS - 1], replace(many, masks=None)):
        assert not isinstance(model().adapt(others), CorrectedField)
    assert not isinstance(test_stacking.model().adapt(many), CorrectedField)
    monkeypatch.setattr(residuals, "MAX_SUPPORT_PIXELS", len(many) * SIZE[0] * SIZE[1] - 1)
    assert not isinstance(model().adapt(many), CorrectedField)


def test_fine_tuned_random_and_swapped_fields_are_corrected_too(many):
    adapter, other = model(), ball_views(ring(6, SIZE), colour=(0.1, 0.3, 0.9))
    assert isinstance(FineTuned(adapter, 1).adapt(many), CorrectedField)
    assert isinstance(FromScratch(adapter, 1).adapt(many), CorrectedField)
    assert isinstance(Swapped(adapter, [many, other]).adapt(many), CorrectedField)


def test_the_field_of_unsuccessful_steps_is_corrected_too(many, query, monkeypatch):
    tuned = FineTuned(model(azimuth=0.7), 1)
    expected = tuned.adapt(many)
    monkeypatch.setattr(Descent, "errors", lambda self: (0.0, 0.0))
    found = Unchecked(tuned).adapt(many)
    assert isinstance(found, CorrectedField)
    assert torch.equal(found.render(query.cameras).images, expected.render(query.cameras).images)


def test_a_cached_field_is_corrected_in_the_same_way(many, query, tmp_path):
    adapter = model(azimuth=0.7)
    field = adapter.adapt(many)
    keep_field(adapter, field, tmp_path / "kept")
    found = recall_field(tmp_path / "kept", many)
    assert isinstance(found, CorrectedField)
    torch.testing.assert_close(found.render(query.cameras).images, field.render(query.cameras).images)
