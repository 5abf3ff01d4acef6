"""Source of truth: the same points in another order, and bounding balls of a few points."""

import pytest
import torch

from hyperplanes.data.pictures.bounds import smallest_ball


def test_the_ball_around_voxels_does_not_depend_on_their_order():
    generator = torch.Generator().manual_seed(0)
    cells = torch.cartesian_prod(*[torch.arange(12)] * 3)
    within = ((cells - torch.tensor([5.2, 5.7, 6.1])) / torch.tensor([5.0, 4.0, 6.0])).norm(dim=1) < 1
    points = cells[within] * torch.tensor([0.13, 0.2, -0.31])
    ball = smallest_ball(points)
    for order in (torch.randperm(len(points), generator=generator), torch.arange(len(points)).flip(0)):
        assert smallest_ball(points[order]).radius == pytest.approx(ball.radius, rel=1e-6)
    assert float((points - torch.tensor(ball.centre)).norm(dim=1).max()) == pytest.approx(ball.radius, rel=1e-6)


@pytest.mark.parametrize(
    ("points", "radius"),
    [
        ([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], 1.0),
        ([[0.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, 1.0]], 2.0),  # the point between the others changes nothing
    ],
)
def test_the_ball_around_few_points(points, radius):
    assert smallest_ball(torch.tensor(points)).radius == pytest.approx(radius, rel=0.03)


def test_the_ball_around_one_voxel_is_its_margin():
    ball = smallest_ball(torch.tensor([[1.0, 2.0, 3.0]]), 0.25)
    assert (ball.centre, ball.radius) == ((1.0, 2.0, 3.0), 0.25)
