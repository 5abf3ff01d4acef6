"""Sources of truth: a loop over pixels and support views, and a ball whose pictures are known."""

import math

import pytest
import torch

from hyperplanes.adaptation import ResidualField, WithResiduals, residuals
from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere, cast
from hyperplanes.rendering import RayMarching
from hyperplanes.utilities.metrics import psnr
from hyperplanes.views import Views
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
    """A field that counts the pictures that are asked for."""

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
    return ball_views(ring(6, SIZE, shift=1))


def test_a_field_of_a_wrong_colour_is_corrected_and_by_other_views_it_is_not(support, query):
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


def test_of_what_a_field_shows_already_nothing_is_added(query):
    grey = ball((0.5, 0.5, 0.5))
    shown = grey.render(ring(12, SIZE))
    views = Views(shown.images, ring(12, SIZE), None, Sphere())
    torch.testing.assert_close(
        ResidualField(grey, views).render(query.cameras).images, grey.render(query.cameras).images, atol=1e-6, rtol=0
    )


def test_a_pixel_has_the_weighted_residuals_of_a_loop_over_the_views(support):
    grey, asked = ball((0.5, 0.5, 0.5)), camera_at((0.4, 0.8, 2.9), SIZE)
    plain, found = grey.render(asked), ResidualField(grey, support).render(asked).images[0]
    own = grey.render(support.cameras)
    checked = 0
    for row, column in [(8, 12), (12, 12), (14, 9), (12, 15)]:
        depth, opacity = (float(each[0, 0, row, column]) for each in (plain.depth, plain.opacity))
        ray = cast(asked, torch.tensor([0]), torch.tensor([[column, row]]), support.bounds)
        point = ray.origins[0] + depth * ray.directions[0]
        total, weights = torch.zeros(3), residuals.DOUBT
        for view in range(len(support)):
            one = camera.select(support.cameras, [view])
            if towards(one) @ towards(asked) <= residuals.WIDEST:
                continue
            x, y = one.project(point[None].to(one.extrinsics))[0].tolist()
            left, top = math.floor(x), math.floor(y)
            share = {
                (top + j, left + i): abs(1 - i - (x - left)) * abs(1 - j - (y - top)) for i in (0, 1) for j in (0, 1)
            }
            lacking, moment, covered = torch.zeros(3), 0.0, 0.0
            for (at, along), part in share.items():
                lacking += part * (support.images - own.images)[view, :, at, along]
                moment += part * float(own.depth[view, 0, at, along] * own.opacity[view, 0, at, along])
                covered += part * float(own.opacity[view, 0, at, along])
            offset = point - camera.centres(one)[0].to(point)
            apart = (float(offset.norm()) - moment / max(covered, 1e-3)) / (residuals.TOLERANCE * support.bounds.radius)
            cosine = float(offset @ ray.directions[0].to(offset) / offset.norm())
            weight = math.exp(-(apart**2) + residuals.SHARPNESS * (cosine - 1))
            total, weights = total + weight * lacking, weights + weight
        expected = plain.images[0, :, row, column] + min(1, opacity / residuals.SOLID) * total / weights
        torch.testing.assert_close(found[:, row, column], expected.clamp(0, 1), atol=2e-4, rtol=0)
        checked += bool((expected - plain.images[0, :, row, column]).abs().max() > 0.1)
    assert checked == 4


def test_views_that_another_surface_hides_add_nothing():
    # A large ball hides the small one behind it from the only view: what that view lacks is not the small one's.
    def two(points, directions):
        near, far = points.norm(dim=-1) < 0.3, (points - points.new_tensor([0.0, 0.0, -0.8])).norm(dim=-1) < 0.15
        return torch.full_like(points, 0.5), 400.0 * (near | far)

    field = AdaptedField(two, full(Sphere(), 32), RayMarching(96, 0.02))
    front, aside = camera_at((0.0, 0.0, 3.0), (48, 48)), camera_at((2.2, 0.0, 2.0), (48, 48))
    plain = field.render(aside)
    view = Views(1 - field.render(front).images, front, None, Sphere())  # it lacks a lot
    added = (ResidualField(field, view).render(aside).images - plain.images).abs().sum(1)[0]
    small = plain.depth[0, 0] > 3.2
    assert small.sum() > 10
    assert added[small].max() < 0.01 < added.max()


def test_only_views_from_that_side_are_rendered_and_each_of_them_once(support):
    counting = Counting(ball((0.5, 0.5, 0.5)))
    corrected = ResidualField(counting, support)
    asked = camera_at((0.0, 0.0, 3.0), SIZE)
    near = int((support.camera_directions @ towards(asked) > 0.5).sum())
    first = corrected.render(asked).images
    assert counting.rendered == 1 + near < 13
    assert torch.equal(corrected.render(asked).images, first)
    assert counting.rendered == 2 + near
    corrected.render(ring(24, SIZE))
    corrected.render(ring(24, SIZE))
    assert counting.rendered == 2 + 24 + 48


def test_many_cameras_show_what_each_shows_alone_and_opacity_and_depth_stay(support, query):
    grey = ball((0.5, 0.5, 0.5))
    corrected, plain = ResidualField(grey, support), grey.render(query.cameras)
    together = corrected.render(query.cameras)
    assert torch.equal(together.opacity, plain.opacity)
    assert torch.equal(together.depth, plain.depth)
    assert float(together.images.min()) >= 0 <= float(together.images.max()) <= 1
    for view in range(len(query)):
        alone = ResidualField(grey, support).render(camera.select(query.cameras, [view])).images[0]
        torch.testing.assert_close(together.images[view], alone, atol=2e-3, rtol=0)


def test_from_the_other_side_alone_nothing_is_known():
    back = ball_views(camera_at((0.0, 0.0, -3.0), SIZE))
    grey, asked = ball((0.5, 0.5, 0.5)), camera_at((0.0, 0.0, 3.0), SIZE)
    assert torch.equal(ResidualField(grey, back).render(asked).images, grey.render(asked).images.clamp(0, 1))


def test_a_method_is_corrected_object_by_object(support, query):
    class Grey:
        def adapt(self, support):
            return ball((0.5, 0.5, 0.5))

    found = WithResiduals(Grey()).adapt(support)
    assert torch.equal(
        found.render(query.cameras).images,
        ResidualField(ball((0.5, 0.5, 0.5)), support).render(query.cameras).images,
    )
