"""Source of truth: a ball of one colour, a ball whose sides differ, and its masks."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool2d

from hyperplanes.adaptation import HullBlend
from hyperplanes.adaptation.base import hull
from hyperplanes.adaptation.baselines import hull_blend
from hyperplanes.geometry import Sphere
from hyperplanes.geometry.cameras import camera_from_world, concatenate, with_poses
from hyperplanes.geometry.chosen_views import PENALTY_RADIANS
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.visibility import penalties as view_penalties
from hyperplanes.geometry.visibility.hull_hits import centres_in_hull
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.rendering import RayMarching
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views
from tests.reference_rendering import ball_views, camera_at, ring

SMALL = HullBlend(side=20, steps=64)


def painted(cameras, colours):
    """A ball that has one flat colour in each view."""
    views = ball_views(cameras)
    flat = torch.tensor(colours, dtype=torch.float32)[:, :, None, None]
    return Views(torch.where(views.masks > 0, flat, torch.ones(())), cameras, views.masks, views.bounds)


def test_a_ball_of_one_colour_has_this_colour_in_new_views():
    blue = (0.2, 0.6, 0.9)
    cameras = ring(1, (24, 24), shift=5)
    pictures = SMALL.adapt(painted(ring(10, (24, 24)), [blue] * 10)).render(cameras)
    truth = ball_views(cameras).masks
    inside = max_pool2d(1 - truth, 7, 1, 3) == 0  # three pixels from the edge
    found = pictures.images.movedim(1, -1)[inside[:, 0]]
    torch.testing.assert_close(found, torch.tensor(blue).expand_as(found), atol=0.01, rtol=0)
    assert (pictures.opacity[inside] > 0.99).all()
    assert (pictures.opacity[max_pool2d(truth, 7, 1, 3) == 0] == 0).all()


def test_the_picture_of_a_support_camera_is_nearly_its_image():
    views = ball_views(ring(8, (24, 24)), colour=(0.9, 0.5, 0.2))
    found = SMALL.adapt(views).render(views[:2].cameras).images
    assert psnr(found, views.images[:2]).mean() > 25


def balls_at(cameras, centre, radius):
    """Masks of a ball at any position."""
    moved = camera_from_world(cameras).clone()
    moved[:, :3, 3] += moved[:, :3, :3] @ torch.tensor(centre)
    return ball_views(with_poses(cameras, moved), radius=radius).masks


@pytest.mark.parametrize("compiled", [True, False])
def test_a_view_in_which_a_ball_is_occluded_does_not_colour_it(monkeypatch, compiled):
    """Two balls in a row: the nearest view, which is red, sees only one of them; all other views are blue."""
    if not compiled:
        monkeypatch.setattr(VisibilityPlanes, "has_kernels", lambda self, points: False)
    near, far = ((0.6, 0.0, 0.0), 0.3), ((-0.5, 0.0, 0.0), 0.25)
    turns = torch.arange(1, 8) * (torch.pi / 4)
    eyes = [(3.0, 0.0, 0.0), *torch.stack([3 * turns.cos(), 0 * turns, 3 * turns.sin()], 1).tolist(), (0.3, 3.0, 0.0)]
    cameras = concatenate([camera_at(tuple(eye), (48, 48)) for eye in eyes])
    masks = torch.maximum(balls_at(cameras, *near), balls_at(cameras, *far))
    colours = torch.tensor([[1.0, 0.0, 0.0]] + [[0.0, 0.0, 1.0]] * 8)[:, :, None, None]
    support = Views(torch.where(masks > 0, colours, torch.ones(())), cameras, masks, Sphere())
    above = camera_at((2.85, 0.9, 0.0), (48, 48))
    only_far = (balls_at(above, *far) == 1) & (max_pool2d(balls_at(above, *near), 5, 1, 2) == 0)
    assert only_far.sum() > 5

    def redness():
        red, _, blue = HullBlend(side=48, steps=96).adapt(support).render(above).images[0][:, only_far[0, 0]].mean(1)
        return float(red / (red + blue))

    assert redness() < 0.15
    nothing = lambda self, voxels: with_surface(self, Occupancy(torch.zeros_like(voxels.occupied), voxels.bounds))  # noqa: E731
    with_surface = VisibilityPlanes.with_surface
    monkeypatch.setattr(VisibilityPlanes, "with_surface", nothing)
    assert redness() > 0.5  # if nothing occludes it


@pytest.mark.parametrize("compiled", [True, False])
def test_there_is_no_seam_where_an_image_border_cuts_the_object(monkeypatch, compiled):
    """A near, red view whose lower border cuts the ball, and a farther, blue one that shows all of it."""
    if not compiled:
        monkeypatch.setattr(VisibilityPlanes, "has_kernels", lambda self, points: False)
    eyes = [(2.2, 0.1, 0.0), (2.9, 0.1, 0.5), (-3.0, 0.0, 0.0), (0.0, 0.2, -3.0)]
    targets = [(0.0, 0.65, 0.0)] + [(0.0, 0.0, 0.0)] * 3
    cameras = concatenate([camera_at(eye, (48, 48), target=at) for eye, at in zip(eyes, targets, strict=True)])
    support = painted(cameras, [(1.0, 0.0, 0.0)] + [(0.0, 0.0, 1.0)] * 3)
    assert support.masks[0, 0, -1].sum() > 10  # cut by the border

    def steepest():
        red = HullBlend(side=48, steps=96).adapt(support).render(camera_at((2.9, 0.1, 0.1), (96, 96))).images[0, 0]
        column = red[:, 47][ball_views(camera_at((2.9, 0.1, 0.1), (96, 96))).masks[0, 0, :, 47] > 0][3:-3]
        assert column[0] > 0.7 > 0.1 > column[-1]  # from red to blue
        return float(column.diff().abs().max())

    smooth = steepest()
    monkeypatch.setattr(view_penalties, "MIN_CROPPED_SHARE", 10.0)  # without the treatment of borders
    assert steepest() > 3 * smooth


def test_the_result_does_not_depend_on_the_origin_of_the_world():
    red, green = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    eyes = [(3.0, 0.0, 0.0), (-3.0, 0.0, 0.0), (0.0, 0.2, 3.0), (0.0, 0.2, -3.0)]
    here = painted(concatenate([camera_at(eye, (24, 24)) for eye in eyes]), [red, green, green, green])
    moved = camera_from_world(here.cameras).clone()
    place = torch.tensor([9.0, -1.0, 2.0])
    moved[:, :3, 3] -= moved[:, :3, :3] @ place
    there = replace(here, cameras=with_poses(here.cameras, moved), bounds=Sphere(tuple(place.tolist())))
    one, other = (SMALL.adapt(views).render(views.cameras).images for views in (here, there))
    torch.testing.assert_close(one, other, atol=2e-2, rtol=0)


def test_the_result_does_not_depend_on_the_order_of_the_views():
    views, cameras = ball_views(ring(6)), ring(1, shift=1)
    one = SMALL.adapt(views).render(cameras).images
    other = SMALL.adapt(views[[3, 1, 5, 0, 2, 4]]).render(cameras).images
    torch.testing.assert_close(one, other)


def test_views_without_masks_are_refused():
    with pytest.raises(ValueError, match="hull_blend: expected support views with masks, got none"):
        SMALL.adapt(ball_views(ring(4), masks=False))


def test_rendering_the_first_sample_agrees_with_compositing_all(monkeypatch):
    """The kernel, which stops at the first sample, is compared with compositing all samples of an opaque field."""
    monkeypatch.setattr(hull_blend, "OPACITY_TOLERANCE", 0.0)
    blend = SMALL.adapt(ball_views(ring(7, (24, 24)), colour=(0.9, 0.5, 0.2)))
    cameras = ring(3, (40, 30), shift=1)
    marching = blend.sampling.for_rendering(50)
    first = blend.render(cameras, marching)
    every = blend.render(cameras, RayMarching(marching.steps, marching.stop))
    torch.testing.assert_close(first.images, every.images, atol=1e-4, rtol=0)
    torch.testing.assert_close(first.depth, every.depth, atol=1e-4, rtol=0)
    assert first.samples < every.samples / 4


def test_starting_rays_at_the_box_of_the_hull_does_not_change_pictures(monkeypatch):
    views, grid, cameras = ball_views(ring(8)), full(Sphere(), 20), ring(3, (30, 30), shift=1)
    near = (grid.centres().norm(dim=1) < 0.8).reshape(20, 20, 20)  # without the corners, outside all views
    planes = VisibilityPlanes(views.images, views.cameras, views.masks, Occupancy(near, Sphere()))
    field = SMALL.adapt_to(planes)
    assert max(field.refined_occupancy.box) < 0.9
    found = field.render(cameras)
    for scale, same in ((2.0, True), (0.3, False)):
        monkeypatch.setattr(Occupancy, "box", (-scale,) * 3 + (scale,) * 3)
        rendered = field.render(cameras)
        assert torch.equal(found.depth, rendered.depth) == same
        assert (found.samples == rendered.samples) == same


def test_a_masked_view_does_not_carve_the_hull(monkeypatch):
    views = ball_views(ring(6, (24, 24)))
    nothing = Views(views.images, views.cameras, views.masks.index_fill(0, torch.tensor([4]), 0.0), views.bounds)
    planes = VisibilityPlanes(nothing.images, nothing.cameras, nothing.masks, hull(views, 20))
    cameras = ring(1, (24, 24), shift=1)
    assert SMALL.adapt_to(planes).render(cameras).opacity.max() == 0
    hidden = planes.mask_views(torch.tensor([4]))
    opacity = SMALL.adapt_to(hidden).render(cameras).opacity
    monkeypatch.setattr(VisibilityPlanes, "has_kernels", lambda self, points: False)
    torch.testing.assert_close(opacity, SMALL.adapt_to(hidden).render(cameras).opacity, atol=1e-4, rtol=0)
    assert opacity.max() == 1


@pytest.mark.parametrize("masked", [[], [2]])
def test_centres_of_voxels_are_in_the_hull_if_all_views_cover_them(masked):
    """The kernel is compared with the least opacity of each centre over the views, some of which do not show it."""
    views = ball_views(ring(5, (24, 20), angle=0.5), radius=0.6)
    planes = VisibilityPlanes(views.images, views.cameras, views.masks, full(Sphere((0.1, 0.0, -0.1), 1.2), 19))
    planes = planes.mask_views(torch.tensor(masked, dtype=torch.long))
    inside = centres_in_hull(planes, 0.5).occupied.flatten()
    coverage = planes.choose(planes.occupancy.centres(), best=0).coverage
    clear = (coverage - 0.5).abs() > 1e-4
    assert torch.equal(inside[clear], (coverage > 0.5)[clear])
    assert 0.02 < inside.float().mean() < 0.5


def test_points_that_no_view_sees_are_coloured_by_the_nearest_views():
    """A point inside the ball is occluded in all views; they are then weighted by angle alone."""
    colours = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 0.0), (0.0, 1.0, 1.0)]
    eyes = torch.nn.functional.normalize(torch.randn(5, 3, generator=torch.Generator().manual_seed(1)), dim=1) * 3
    support = painted(concatenate([camera_at(tuple(eye.tolist()), (32, 32)) for eye in eyes]), colours)
    point, direction = torch.tensor([[0.2, 0.1, 0.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    found, _ = HullBlend(nearest=2, side=32).adapt(support).field(point, direction)
    rays = torch.nn.functional.normalize(point - eyes, dim=1)
    score, order = (1 * PENALTY_RADIANS + torch.acos((rays * direction).sum(1))).sort()
    weights = 1 / score[:2] - 1 / (1.01 * score[2])
    expected = (weights[:, None] * torch.tensor(colours)[order[:2]]).sum(0) / weights.sum()
    torch.testing.assert_close(found[0], expected, atol=1e-2, rtol=0)
