"""Sources of truth: closed forms, the histogram that importance samples reproduce, and NeRF's own placement."""

import numpy as np
import pytest
import torch

from hyperplanes.geometry.rays import Rays
from hyperplanes.rendering import Hierarchical, importance, intervals, render, stratified
from tests.reference_rendering import some_rays


def rays_between(near, far, count):
    zeros = torch.zeros(count, 3)
    return Rays(zeros, zeros, torch.full((count,), near), torch.full((count,), far))


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def drawn_in_intervals(rays, count, generator):
    return stratified(intervals(rays, count), generator)


def resampled(rays, count, generator):
    return importance(intervals(rays, 4), torch.ones(len(rays), 4), count, generator)


def distance_to_uniform(values):
    """The Kolmogorov-Smirnov statistic of values against U(0, 1)."""
    ordered = values.flatten().sort().values
    ranks = (torch.arange(len(ordered)) + 0.5) / len(ordered)
    return (ordered - ranks).abs().max().item()


def test_intervals_are_equal_and_samples_their_middles_without_a_generator():
    edges = intervals(rays_between(2.0, 6.0, 2), 4)
    assert edges.tolist() == [[2.0, 3.0, 4.0, 5.0, 6.0]] * 2
    assert stratified(edges).tolist() == [[2.5, 3.5, 4.5, 5.5]] * 2


def test_samples_are_uniform_within_their_intervals_each_its_own():
    # NeRF, Eq. 2: t_i ~ U(near + (i - 1) / N (far - near), near + i / N (far - near))
    count = 8
    drawn = stratified(intervals(rays_between(2.0, 6.0, 4000), count), generator())
    place = (drawn - 2) / 4 * count - torch.arange(count)
    assert place.min() >= -1e-5
    assert place.max() <= 1 + 1e-5
    # the 1e-6 quantile of the statistic is 2.7 / sqrt(n)
    for interval in range(count):
        assert distance_to_uniform(place[:, interval]) < 2.7 / len(place) ** 0.5
    assert abs(torch.corrcoef(place.T)[0, 1]) < 0.1


def test_samples_of_intervals_of_any_length_stay_in_them():
    edges = torch.tensor([[0.0, 0.1, 2.0, 2.0, 5.0]]).expand(100, -1)
    drawn = stratified(edges, generator())
    assert ((drawn >= edges[:, :-1]) & (drawn <= edges[:, 1:])).all()


def test_the_sum_over_samples_is_the_integral_on_average():
    # the integral of t^2 from 0 to 1 is 1/3; with midpoints of 3 intervals, it would always be 35/108 = 0.324
    drawn = stratified(intervals(rays_between(0.0, 1.0, 40_000), 3), generator())
    assert (drawn.square().sum(1) / 3).mean().item() == pytest.approx(1 / 3, abs=2e-3)


def test_a_ray_that_misses_has_intervals_of_no_length():
    edges = intervals(rays_between(3.0, 3.0, 2), 5)
    assert (edges == 3).all()
    assert (stratified(edges, generator()) == 3).all()
    again = importance(edges, torch.zeros(2, 5), 4, generator())
    assert (again == 3).all()


@pytest.mark.parametrize("draw", [drawn_in_intervals, resampled])
def test_the_same_generator_draws_the_same(draw):
    rays = rays_between(1.0, 2.0, 3)
    assert torch.equal(draw(rays, 6, generator(1)), draw(rays, 6, generator(1)))
    assert not torch.equal(draw(rays, 6, generator(1)), draw(rays, 6, generator(2)))


def test_importance_reproduces_its_histogram():
    edges = torch.tensor([[0.0, 0.5, 2.0, 2.1, 4.0]]).expand(2000, -1)
    weights = torch.tensor([[0.1, 0.4, 0.2, 0.3]]).expand(2000, -1)
    drawn = importance(edges, weights, 10, generator())
    assert drawn.shape == (2000, 10)
    counts = torch.histogram(drawn, edges[0].contiguous()).hist / drawn.numel()
    # 20,000 draws: one standard deviation is at most 0.0035, less because they are stratified
    torch.testing.assert_close(counts, weights[0], atol=0.01, rtol=0)
    for low, high in zip(edges[0], edges[0, 1:], strict=False):
        inside = drawn[(drawn >= low) & (drawn < high)]
        assert distance_to_uniform((inside - low) / (high - low)) < 2.7 / len(inside) ** 0.5


def test_importance_without_a_generator_takes_even_quantiles():
    # cumulative 0.25 at t = 1, 1 at t = 2; quantiles 1/8, 3/8, 5/8, 7/8 -> 1/2, 1 + 1/6, 1 + 3/6, 1 + 5/6
    drawn = importance(torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[1.0, 3.0]]), 4)
    torch.testing.assert_close(drawn, torch.tensor([[1 / 2, 7 / 6, 9 / 6, 11 / 6]]), atol=1e-4, rtol=0)


def test_importance_ascends_within_its_edges():
    edges = torch.rand(50, 9, generator=generator()).sort(1).values
    weights = torch.rand(50, 8, generator=generator(1)) ** 8
    drawn = importance(edges, weights, 33, generator(2))
    assert (drawn.diff(dim=1) >= 0).all()
    assert ((drawn >= edges[:, :1]) & (drawn <= edges[:, -1:])).all()


def test_importance_of_no_weight_at_all_is_uniform():
    drawn = importance(torch.linspace(0, 1, 9).expand(400, -1), torch.zeros(400, 8), 16, generator())
    assert distance_to_uniform(drawn) < 2.7 / drawn.numel() ** 0.5


def test_importance_passes_no_gradient_to_the_weights_but_to_the_edges():
    edges = torch.linspace(0, 1, 5, dtype=torch.float64)[None].requires_grad_()
    weights = torch.rand(1, 4, dtype=torch.float64, generator=generator(), requires_grad=True)
    importance(edges, weights, 3).sum().backward()
    assert weights.grad is None
    # with quantiles fixed, a shift of all edges shifts every distance by the same: the gradient sums to 3
    assert edges.grad.sum().item() == pytest.approx(3)


def test_placement_at_samples_agrees_with_nerf():
    """Source of truth: section 5.2 of NeRF in NumPy, ray by ray, with a field of varying colour and density."""

    def field(points, directions):
        return torch.sigmoid(3 * points), 6 * torch.exp(-4 * points.square().sum(-1))

    rays, coarse, fine = some_rays(5), 9, 14

    def pixel(ray, t):
        points = rays.origins[ray] + torch.tensor(t)[:, None] * rays.directions[ray]
        colour, density = (value.numpy() for value in field(points, points))
        alpha = 1 - np.exp(-density * np.diff(t, append=float(rays.far[ray])))
        weights = alpha * np.concatenate([[1.0], np.cumprod(1 - alpha)[:-1]])
        return weights @ colour + 1 - weights.sum(), weights

    found = render(field, rays, Hierarchical(coarse, fine, "samples"))
    for ray in range(5):
        near, far = float(rays.near[ray]), float(rays.far[ray])
        t = near + (far - near) * (np.arange(coarse) + 0.5) / coarse
        first, weights = pixel(ray, t)
        mass = weights[1:-1] + 1e-5
        cumulative = np.concatenate([[0.0], np.cumsum(mass / mass.sum())])
        added = np.interp((np.arange(fine) + 0.5) / fine, cumulative, (t[1:] + t[:-1]) / 2)
        last, _ = pixel(ray, np.sort(np.concatenate([t, added])))
        assert found.coarse.colour[ray].numpy() == pytest.approx(first, abs=1e-9)
        assert found.colour[ray].numpy() == pytest.approx(last, abs=1e-9)
    assert found.samples == 5 * (coarse + coarse + fine)


def test_placements_agree_for_many_samples_and_unknown_ones_are_refused():
    def field(points, directions):
        return torch.sigmoid(3 * points), 6 * torch.exp(-4 * points.square().sum(-1))

    rays = some_rays(20)
    one, other = (render(field, rays, Hierarchical(300, 300, place)).colour for place in ("intervals", "samples"))
    assert (one - other).abs().max() < 5e-3
    with pytest.raises(ValueError, match="placement: expected one of 'intervals', 'samples', got 'edges'"):
        Hierarchical(placement="edges")
    with pytest.raises(ValueError, match="coarse: expected at least 3"):
        Hierarchical(2, 4, "samples")
