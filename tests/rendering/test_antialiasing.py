"""Sources of truth: the mean over many rays per pixel, and the rays of a picture, rendered separately."""

from functools import cache

import pytest
import torch

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import SUBPIXELS, Sphere, cast, pixel_grid
from hyperplanes.rendering import Hierarchical, RayMarching, images, render
from tests.reference_rendering import ball_views, ring

CAMERAS = ring(2, (24, 24))
GRID, MARCH = full(Sphere(), 1), RayMarching(100, 0.02)


def ball(points, directions):
    """An opaque ball of radius 0.5, red above and blue below."""
    colour = torch.where(points[:, 1:2] > 0, points.new_tensor([1.0, 0, 0]), points.new_tensor([0.0, 0, 1]))
    return colour, 400.0 * (points.norm(dim=1) < 0.5)


def haze(points, directions):
    """A field whose pictures have nearly no differences between neighbouring pixels."""
    return torch.full_like(points, 0.5), points[:, 0].square()


def picture(field, antialias, sampling=MARCH, cameras=CAMERAS):
    return render(field, cameras, sampling, occupancy=GRID, antialias=antialias)


@cache
def truth():
    """The mean of 6 x 6 rays over the area of each pixel of the ball."""
    height, width = camera.image_size(CAMERAS)
    fine = picture(ball, False, cameras=camera.resized(CAMERAS, 6 * height, 6 * width))
    return [torch.nn.functional.avg_pool2d(each, 6) for each in (fine.images, fine.opacity)]


def test_pixels_at_edges_are_nearer_to_the_mean_over_their_area():
    with_edges, without = picture(ball, True), picture(ball, False)
    for found, plain, expected in zip(
        (with_edges.images, with_edges.opacity), (without.images, without.opacity), truth(), strict=True
    ):
        assert (found - expected).square().mean() < 0.4 * (plain - expected).square().mean()


def test_five_rays_are_nearer_to_the_mean_than_the_three_of_training(monkeypatch):
    five = (picture(ball, True).images - truth()[0]).square().mean()
    monkeypatch.setattr(images, "EDGE_SUBPIXELS", SUBPIXELS)
    three = (picture(ball, True).images - truth()[0]).square().mean()
    assert five < 0.6 * three


def test_pixels_at_edges_are_the_mean_of_five_rays_and_others_do_not_change():
    found, plain = picture(ball, True), picture(ball, False)
    changed = ((found.images != plain.images).any(1) | (found.opacity != plain.opacity)[:, 0]).nonzero()
    assert 20 < len(changed) < 400
    view, row, column = changed.unbind(1)
    centres = torch.stack([column, row], 1).double()
    rays = [
        render(ball, cast(CAMERAS, view, centres + centres.new_tensor(offset)), MARCH, occupancy=GRID)
        for offset in images.EDGE_SUBPIXELS
    ]
    mean = torch.stack([each.colour for each in rays]).mean(0)
    torch.testing.assert_close(found.images[view, :, row, column], mean.to(found.images), atol=0.02, rtol=0)
    assert torch.equal(found.depth, plain.depth)


@pytest.mark.parametrize("value", range(4))
def test_pixels_at_edges_are_those_that_differ_from_a_neighbour(value):
    # Brute force: a loop over pixels, of one value at a time.
    values = torch.zeros(2, 5, 4, 4)
    values[..., value] = torch.rand(2, 5, 4, generator=torch.Generator().manual_seed(value))
    found = images.pixels_at_edges(values, images.EDGE_THRESHOLD)
    for view, row, column in found.new_ones(found.shape).nonzero().tolist():
        beside = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
        differences = [
            abs(float(values[view, row, column, value] - values[view, *place, value]))
            for place in beside
            if 0 <= place[0] < 5 and 0 <= place[1] < 4
        ]
        assert bool(found[view, row, column]) == (max(differences) >= images.EDGE_THRESHOLD)
    assert 0 < found.sum() < found.numel()


def test_views_are_rendered_in_groups_to_the_same_pictures(monkeypatch):
    together = picture(ball, True)
    monkeypatch.setattr(images, "RAYS_OF_GROUP", 1)
    one_by_one = picture(ball, True)
    for name in ("images", "opacity", "depth"):
        torch.testing.assert_close(getattr(together, name), getattr(one_by_one, name), atol=1e-6, rtol=0)
    assert together.samples == one_by_one.samples


def test_additional_rays_are_counted_and_used_only_where_pixels_differ():
    assert picture(ball, True).samples > picture(ball, False).samples
    found, plain = picture(haze, True), picture(haze, False)
    assert found.samples == plain.samples
    assert torch.equal(found.images, plain.images)


@pytest.mark.parametrize("sampling", [MARCH, Hierarchical(16, 16)])
def test_antialiasing_is_the_default_only_with_ray_marching(sampling):
    default = picture(ball, None, sampling).images
    assert torch.equal(default, picture(ball, isinstance(sampling, RayMarching), sampling).images)
    assert not torch.equal(picture(ball, True, sampling).images, picture(ball, False, sampling).images)


def test_a_picture_with_gradients_has_one_ray_per_pixel():
    seen = render(ball, CAMERAS, MARCH, occupancy=GRID, differentiable=True)
    pixels = pixel_grid(24, 24)
    rays = cast(CAMERAS, torch.zeros(len(pixels), dtype=torch.long), pixels)
    expected = render(ball, rays, MARCH, occupancy=GRID).colour.reshape(24, 24, 3).permute(2, 0, 1)
    torch.testing.assert_close(seen.images[0], expected.to(seen.images), atol=1e-5, rtol=0)


def test_a_picture_that_is_one_pixel_has_no_edges():
    cameras = camera.resized(CAMERAS, 1, 1)
    assert torch.equal(picture(ball, True, cameras=cameras).images, picture(ball, False, cameras=cameras).images)


def test_rays_of_the_same_pixel_are_averaged():
    views = ball_views(CAMERAS)
    generator = [torch.Generator().manual_seed(3) for _ in range(2)]
    among = picture(ball, True).opacity.flatten().nonzero()[:, 0]
    rays, truth, opacity = views.sample_masked_rays(60, generator=generator[0], among=among, subpixels=SUBPIXELS)
    single, same, _ = views.sample_masked_rays(60, generator=generator[1], among=among)
    assert len(rays) == 3 * len(truth) == 3 * len(opacity) == 180
    assert torch.equal(truth, same)
    seen, first = (render(ball, each, MARCH, occupancy=GRID) for each in (rays, single))
    pooled_rays = seen.pooled(3)
    torch.testing.assert_close(pooled_rays.colour, (seen.colour[:60] + seen.colour[60:120] + seen.colour[120:]) / 3)
    torch.testing.assert_close(pooled_rays.opacity, seen.opacity.view(3, 60).mean(0))
    assert torch.equal(pooled_rays.depth, first.depth)
    assert pooled_rays.samples == seen.samples
    assert first.pooled(1) is first
