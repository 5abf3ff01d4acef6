"""Sources of truth: two slabs by hand, constant density in closed form, the loops of tests/reference.py, gradcheck."""

import math

import pytest
import torch

from hyperplanes.rendering import composite, composite_packed, packed_weights
from tests.reference_rendering import composite_ray

DOUBLE = torch.float64


def random_rays(rays=5, intervals=7, seed=0):
    generator = torch.Generator().manual_seed(seed)
    colour = torch.rand(rays, intervals, 3, generator=generator, dtype=DOUBLE)
    density = 3 * torch.rand(rays, intervals, generator=generator, dtype=DOUBLE)
    edges = torch.rand(rays, intervals + 1, generator=generator, dtype=DOUBLE).sort(1).values + 1
    return colour, density, edges


def test_two_slabs_by_hand():
    # Slab 1 on [0, 1], sigma = ln 2, red:  alpha = 1/2, T = 1    -> w = 1/2
    # Slab 2 on [1, 2], sigma = ln 4, blue: alpha = 3/4, T = 1/2  -> w = 3/8
    # white behind: T = 1/8.  colour = (1/2 + 1/8, 1/8, 3/8 + 1/8), opacity = 7/8,
    # depth = (1/2 * 1/2 + 3/8 * 3/2) / (7/8) = (13/16) / (7/8) = 13/14
    colour = torch.tensor([[[1.0, 0, 0], [0, 0, 1.0]]])
    density = torch.tensor([[math.log(2), math.log(4)]])
    edges = torch.tensor([[0.0, 1.0, 2.0]])
    seen, weights = composite(colour, density, edges)
    packed = packed_weights(density[0], torch.tensor([0, 0]), 1)
    for weight in (weights[0], packed):
        torch.testing.assert_close(weight, torch.tensor([0.5, 0.375]))
    also = composite_packed(colour[0], packed, torch.tensor([0.5, 1.5]), torch.tensor([0, 0]), 1)
    for result in (seen, also):
        torch.testing.assert_close(result.colour, torch.tensor([[0.625, 0.125, 0.5]]))
        torch.testing.assert_close(result.opacity, torch.tensor([0.875]))
        torch.testing.assert_close(result.depth, torch.tensor([13 / 14]))


@pytest.mark.parametrize("sigma", [0.01, 1.0, 7.0])
def test_constant_density_in_closed_form(sigma):
    near, length, count = 1.5, 2.0, 2000
    edges = torch.linspace(near, near + length, count + 1, dtype=DOUBLE)[None]
    density = torch.full((1, count), sigma, dtype=DOUBLE)
    colour = torch.full((1, count, 3), 0.25, dtype=DOUBLE)
    seen, _ = composite(colour, density, edges)
    opacity = 1 - math.exp(-sigma * length)
    # E[t] of the exponential distribution cut off at L: near + 1/sigma - L exp(-sigma L) / opacity
    depth = near + 1 / sigma - length * math.exp(-sigma * length) / opacity
    assert seen.opacity.item() == pytest.approx(opacity, rel=1e-9)
    assert seen.depth.item() == pytest.approx(depth, rel=1e-5)
    assert seen.colour[0].tolist() == pytest.approx([0.25 * opacity + 1 - opacity] * 3, rel=1e-9)
    weights = packed_weights(density[0] * length / count, torch.zeros(count, dtype=torch.long), 1)
    assert weights.sum().item() == pytest.approx(opacity, rel=1e-9)


@pytest.mark.parametrize("background", [0.0, 0.3, 1.0])
def test_dense_equals_the_loop(background):
    colour, density, edges = random_rays()
    seen, weights = composite(colour, density, edges, background)
    for ray in range(len(colour)):
        expected = composite_ray(colour[ray].tolist(), density[ray].tolist(), edges[ray].tolist(), background)
        assert seen.colour[ray].tolist() == pytest.approx(expected[0], abs=1e-12)
        assert seen.opacity[ray].item() == pytest.approx(expected[1], abs=1e-12)
        assert seen.depth[ray].item() == pytest.approx(expected[2], abs=1e-12)
        assert weights[ray].tolist() == pytest.approx(expected[3], abs=1e-12)


def packed_form(keep, *tensors):
    ray = keep.nonzero()[:, 0]
    return ray, [tensor[keep] for tensor in tensors]


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_packed_equals_the_loop_for_ragged_and_empty_rays(background):
    colour, density, edges = random_rays(rays=6)
    keep = torch.rand(6, 7, generator=torch.Generator().manual_seed(1)) < 0.6
    keep[0], keep[3], keep[5] = False, False, False  # the first, the last and a middle ray have no samples
    keep[1], keep[2, 1:] = True, False
    width, middles = edges.diff(dim=1), (edges[:, 1:] + edges[:, :-1]) / 2
    ray, (c, s, w, t) = packed_form(keep, colour, density, width, middles)
    weights = packed_weights(s * w, ray, 6)
    seen = composite_packed(c, weights, t, ray, 6, background)
    for i in range(6):
        emptied = (density[i] * keep[i]).tolist()
        expected = composite_ray(colour[i].tolist(), emptied, edges[i].tolist(), background)
        assert seen.colour[i].tolist() == pytest.approx(expected[0], abs=1e-12)
        assert seen.opacity[i].item() == pytest.approx(expected[1], abs=1e-12)
        assert seen.depth[i].item() == pytest.approx(expected[2], abs=1e-9)
        assert weights[ray == i].tolist() == pytest.approx([w for w, k in zip(expected[3], keep[i], strict=True) if k])


def test_packed_pixels_do_not_depend_on_the_order_of_samples():
    colour, density, edges = random_rays()
    keep = torch.ones(5, 7, dtype=torch.bool)
    ray, (c, s, t) = packed_form(keep, colour, density, edges[:, 1:])
    weights = packed_weights(s * 0.2, ray, 5)
    order = torch.randperm(len(ray), generator=torch.Generator().manual_seed(2))
    one = composite_packed(c, weights, t, ray, 5)
    two = composite_packed(c[order], weights[order], t[order], ray[order], 5)
    torch.testing.assert_close(one.colour, two.colour)
    torch.testing.assert_close(one.depth, two.depth)


def test_weights_sum_to_the_opacity():
    colour, density, edges = random_rays()
    seen, weights = composite(colour, density * 10, edges)
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(1), seen.opacity)
    assert ((seen.depth >= edges[:, 0]) & (seen.depth <= edges[:, -1])).all()


def test_cutting_an_interval_in_two_changes_no_pixel():
    colour, density, edges = random_rays(intervals=4)
    finer = torch.cat([edges, (edges[:, 1:] + edges[:, :-1]) / 2], 1).sort(1).values
    one, _ = composite(colour, density, edges)
    two, _ = composite(colour.repeat_interleave(2, 1), density.repeat_interleave(2, 1), finer)
    torch.testing.assert_close(one.colour, two.colour)
    torch.testing.assert_close(one.opacity, two.opacity)


def test_rays_without_samples_have_the_background():
    nothing = torch.zeros(0, dtype=torch.long)
    weights = packed_weights(torch.zeros(0), nothing, 3)
    seen = composite_packed(torch.zeros(0, 3), weights, torch.zeros(0), nothing, 3, 0.75)
    assert seen.colour.tolist() == [[0.75] * 3] * 3
    assert seen.opacity.tolist() == seen.depth.tolist() == [0.0] * 3


def test_a_ray_late_in_a_large_batch_loses_no_precision():
    # 20,000 rays of optical depth 8 each: a running sum in float32 would be off by about 0.01 at the end.
    rays, count = 20_000, 16
    density = torch.rand(count, generator=torch.Generator().manual_seed(3))
    density[0] += 0.5
    thickness = torch.cat([torch.full((rays - 1, count), 0.5).flatten(), density])
    ray = torch.arange(rays).repeat_interleave(count)
    last = packed_weights(thickness, ray, rays)[-count:]
    torch.testing.assert_close(last, packed_weights(density, torch.zeros(count, dtype=torch.long), 1))


def test_gradients_of_dense_compositing():
    colour, density, edges = (value.requires_grad_() for value in random_rays(rays=3, intervals=4))

    def pixels(*values):
        seen, weights = composite(*values)
        return seen.colour, seen.opacity, seen.depth, weights

    assert all(each.requires_grad for each in pixels(colour, density, edges)), "gradcheck skips the others"
    assert torch.autograd.gradcheck(pixels, (colour, density, edges))


def test_gradients_of_packed_compositing():
    ray = torch.tensor([0, 0, 0, 2, 2, 4])
    generator = torch.Generator().manual_seed(4)
    colour = torch.rand(6, 3, generator=generator, dtype=DOUBLE, requires_grad=True)
    thickness = torch.rand(6, generator=generator, dtype=DOUBLE, requires_grad=True)
    middles = torch.rand(6, generator=generator, dtype=DOUBLE, requires_grad=True)

    def pixels(colour, thickness, middles):
        seen = composite_packed(colour, packed_weights(thickness, ray, 5), middles, ray, 5)
        return seen.colour, seen.opacity, seen.depth

    assert all(each.requires_grad for each in pixels(colour, thickness, middles)), "gradcheck skips the others"
    assert torch.autograd.gradcheck(pixels, (colour, thickness, middles))


def test_packed_gradients_equal_the_dense_ones_on_the_samples_kept():
    colour, density, edges = random_rays(rays=6)
    keep = torch.rand(6, 7, generator=torch.Generator().manual_seed(5)) < 0.5
    width, middles = edges.diff(dim=1), (edges[:, 1:] + edges[:, :-1]) / 2
    truth = torch.rand(6, 3, generator=torch.Generator().manual_seed(6), dtype=DOUBLE)

    dense_colour, dense_density = colour.clone().requires_grad_(), density.clone().requires_grad_()
    seen, _ = composite(dense_colour, dense_density * keep, edges)
    (seen.colour - truth).square().sum().backward()

    ray, (c, s, w, t) = packed_form(keep, colour, density, width, middles)
    c, s = c.clone().requires_grad_(), s.clone().requires_grad_()
    packed = composite_packed(c, packed_weights(s * w, ray, 6), t, ray, 6)
    (packed.colour - truth).square().sum().backward()
    torch.testing.assert_close(c.grad, dense_colour.grad[keep])
    torch.testing.assert_close(s.grad, dense_density.grad[keep])


@pytest.mark.parametrize("sigma", [0.0, 1e6])
def test_gradients_stay_finite_in_empty_and_in_opaque_space(sigma):
    thickness = torch.full((8,), sigma, requires_grad=True)
    ray = torch.tensor([0] * 4 + [1] * 4)
    seen = composite_packed(torch.ones(8, 3), packed_weights(thickness, ray, 2), torch.ones(8), ray, 2, 0.0)
    seen.colour.sum().backward()
    assert torch.isfinite(thickness.grad).all()
    density = torch.full((2, 4), sigma, requires_grad=True)
    seen, _ = composite(torch.ones(2, 4, 3), density, torch.linspace(1, 2, 5).repeat(2, 1), 0.0)
    (seen.colour.sum() + seen.depth.sum()).backward()
    assert torch.isfinite(density.grad).all()


@pytest.mark.parametrize("poison", [math.inf, math.nan, 1e30])
def test_an_invalid_density_affects_only_its_own_ray(poison):
    # Source of truth: the same rays without the invalid density.
    thickness = torch.tensor([0.3, 0.2, 0.5, 0.1, 0.7, 0.4])
    ray = torch.tensor([0, 0, 1, 1, 2, 2])
    whole = packed_weights(thickness, ray, 3)
    thickness[3] = poison
    found = packed_weights(thickness, ray, 3)
    assert torch.equal(found[[0, 1, 2, 4, 5]], whole[[0, 1, 2, 4, 5]])
    if not math.isnan(poison):
        assert found[3].item() == pytest.approx(math.exp(-0.5))  # all remaining transmittance


def test_an_infinite_density_on_a_ray_that_misses_is_not_seen():
    """All edges of such a ray are at one distance; packed, it has no samples. In the other ray it is opaque."""
    edges = torch.tensor([[2.0, 2.0, 2.0], [2.0, 3.0, 4.0]])
    density = torch.full((2, 2), math.inf, requires_grad=True)
    seen, weights = composite(torch.full((2, 2, 3), 0.25), density, edges)
    assert seen.colour.tolist() == [[1.0] * 3, [0.25] * 3]
    assert weights.tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert seen.opacity.tolist() == [0.0, 1.0]


def test_the_depth_is_that_of_given_distances():
    # two samples of weights 1/2 and 1/4 at 1.1 and 2.4 in the intervals (1, 2) and (2, 3): (0.55 + 0.6) / 0.75
    density = torch.full((1, 2), math.log(2.0))
    seen, _ = composite(
        torch.ones(1, 2, 3), density, torch.tensor([[1.0, 2.0, 3.0]]), distances=torch.tensor([[1.1, 2.4]])
    )
    assert seen.depth.item() == pytest.approx(1.15 / 0.75)
