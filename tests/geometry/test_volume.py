"""Source of truth: a ball of one colour, with known volume, hull and pictures, and linear functions."""

import math

import pytest
import torch

from hyperplanes.geometry import Sphere, carve
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.geometry.volume import VALUES_PER_CELL, VOLUME_SIDE, interpolate_grid, volume_of
from tests.reference_rendering import ball_views, ring


def planes_of(views, side=64):
    hull = carve(views.masks, views.cameras, views.bounds, side)
    return VisibilityPlanes(views.images, views.cameras, views.masks, hull)


def test_the_occupied_shares_of_cells_are_those_of_the_hull():
    planes = planes_of(ball_views(ring(20, (48, 48))))
    share = volume_of(planes)[0]
    assert share.shape == (VOLUME_SIDE, VOLUME_SIDE, VOLUME_SIDE)
    assert float(share.sum()) * 8 == pytest.approx(int(planes.occupancy.occupied.sum()))
    ball = 4 / 3 * math.pi * 0.5**3
    assert ball < float(share.sum()) * (2 / VOLUME_SIDE) ** 3 < 1.4 * ball  # the hull contains the ball


def test_cells_at_the_surface_have_the_colour_of_the_ball_and_those_outside_are_zero():
    views = ball_views(ring(20, (48, 48)))
    volume = volume_of(planes_of(views))
    share, colour = volume[0], volume[1:4]
    inside = share == 1
    hue = (colour[:, inside].mean(1) + 1) / 2
    torch.testing.assert_close(hue / hue[0], torch.tensor([1.0, 0.25, 0.125]), atol=0.05, rtol=0)
    upper, lower = (colour[0, :, half][inside[:, half]].mean() for half in (slice(18, None), slice(None, 14)))
    assert upper > lower + 0.1  # brighter towards +y
    assert not volume[:, share == 0].any()


def test_cells_that_all_views_show_count_all_views():
    volume = volume_of(planes_of(ball_views(ring(7, (48, 48)))))
    assert len(volume) == VALUES_PER_CELL
    assert volume[4].max() == pytest.approx(math.log(7))


@pytest.mark.parametrize("count", [3, 12])
def test_the_kernel_and_plain_pytorch_show_the_same(count, monkeypatch):
    planes = planes_of(ball_views(ring(count, (32, 32))))
    compiled = volume_of(planes)
    monkeypatch.setattr(VisibilityPlanes, "can_describe", lambda planes, *_: False)
    torch.testing.assert_close(compiled, volume_of(planes), atol=1e-5, rtol=1e-4)


def test_the_order_of_the_views_does_not_matter():
    views = ball_views(ring(9, (32, 32)))
    order = torch.randperm(9, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(volume_of(planes_of(views[order])), volume_of(planes_of(views)), atol=1e-5, rtol=1e-4)


def test_a_linear_function_is_interpolated_exactly_and_constant_beyond_the_outermost_centres():
    bounds, weights = Sphere((0.5, -1.0, 2.0), 3.0), torch.tensor([0.3, -0.7, 0.2])
    unit = (torch.arange(VOLUME_SIDE) + 0.5) * (2 / VOLUME_SIDE) - 1
    x, y, z = torch.meshgrid(unit, unit, unit, indexing="ij")
    grid = (x * weights[0] + y * weights[1] + z * weights[2])[None]
    inside = (torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1) * (1 - 1 / VOLUME_SIDE)
    world = inside * bounds.radius + torch.tensor(bounds.centre)
    torch.testing.assert_close(interpolate_grid(grid, world, bounds)[:, 0], inside @ weights, atol=1e-5, rtol=1e-4)
    far = torch.tensor([[50.0, 50.0, 50.0]])
    torch.testing.assert_close(interpolate_grid(grid, far, bounds)[0, 0], grid[0, -1, -1, -1])
