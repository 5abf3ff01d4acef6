"""Sources of truth: fog in a sphere in closed form, loops over single samples, gradcheck, and properties (chunks, other
rays and the background do not change a ray).
"""

import math
import threading
from dataclasses import dataclass

import pytest
import torch
from kornia.geometry.camera import PinholeCamera

import hyperplanes
from hyperplanes.geometry.cameras import pinhole, symmetric_intrinsics
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.rays import Rays, Sphere, cast, pixel_grid
from hyperplanes.rendering import Hierarchical, RayMarching, Sampler, march, render
from hyperplanes.rendering.integration import EXACT
from tests.reference_rendering import ball_hit, composite_ray, ring, soft_ball, some_rays

DOUBLE = torch.float64
GRID = full(Sphere(), 8)
PROTOCOLS = [Hierarchical(16, 0), Hierarchical(16, 32), RayMarching(64)]


def fog(sigma):
    """A field with constant density and the colour (0.2, 0.4, 0.6)."""

    def field(points, directions):
        return points.new_tensor([0.2, 0.4, 0.6]).expand(len(points), 3), points.new_full((len(points),), sigma)

    return field


def clipped(cameras, bounds=None):
    height, width = int(cameras.height[0]), int(cameras.width[0])
    views = cameras.batch_size
    view = torch.arange(views).repeat_interleave(height * width)
    return cast(cameras, view, pixel_grid(height, width).repeat(views, 1), bounds)


@pytest.mark.parametrize("sampling", PROTOCOLS)
@torch.no_grad()
def test_fog_in_a_sphere_in_closed_form(sampling):
    sigma, bounds = 0.7, Sphere((0.2, -0.1, 0.3), 0.8)
    rays = clipped(ring(2, (9, 7)), bounds)
    seen = render(fog(sigma), rays, sampling, occupancy=full(bounds, 8))
    # RayMarching has whole steps, so that lengths differ by at most half a step of 2 r / 64
    slack = sigma * bounds.radius / 64 if isinstance(sampling, RayMarching) else 0
    assert (rays.far > rays.near).any()
    assert (rays.far == rays.near).any()
    for ray in range(len(rays)):
        length = ball_hit(rays.origins[ray].tolist(), rays.directions[ray].tolist(), bounds.centre, bounds.radius)
        opacity = 1 - math.exp(-sigma * length)
        assert seen.opacity[ray].item() == pytest.approx(opacity, abs=2e-5 + slack)
        expected = [opacity * c + 1 - opacity for c in (0.2, 0.4, 0.6)]
        assert seen.colour[ray].tolist() == pytest.approx(expected, abs=2e-5 + slack)


@torch.no_grad()
def test_marched_equals_the_loop_over_its_samples():
    grid = Occupancy(torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(0)) < 0.4, Sphere())
    rays = some_rays(30)
    seen = render(soft_ball, rays, RayMarching(50, 1e-12), occupancy=grid, background=0.2)
    samples = march(rays, grid, 2 / 50)
    for index in range(len(rays)):
        t = samples.distances[samples.ray == index]
        direction = rays.directions[index].expand(len(t), 3)
        colour, density = soft_ball(rays.origins[index] + t[:, None] * direction, direction)
        thickness = [0.0, *(density * 2 / 50).cumsum(0).tolist()]  # gaps between occupied voxels are empty
        expected = composite_ray(colour.tolist(), [1.0] * len(t), thickness, 0.2)
        assert seen.colour[index].tolist() == pytest.approx(expected[0], abs=1e-9)
        assert seen.opacity[index].item() == pytest.approx(expected[1], abs=1e-9)


@torch.no_grad()
def test_marched_converges_to_hierarchical():
    rays = some_rays(60)
    truth = render(soft_ball, rays, Hierarchical(400, 0))
    errors = []
    for steps in (24, 96, 384):
        seen = render(soft_ball, rays, RayMarching(steps, 1e-9), occupancy=GRID)
        errors.append((seen.colour - truth.colour).abs().max().item())
    # by the midpoint rule, four times as many steps reduce the error to a quarter or less
    assert errors[1] < errors[0] / 4
    assert errors[2] < 1e-4
    seen = render(soft_ball, rays, RayMarching(384, 1e-9), occupancy=GRID)
    thick = truth.opacity > 0.05
    assert (seen.depth - truth.depth)[thick].abs().max() < 1e-3


@torch.no_grad()
def test_fine_samples_bring_the_coarse_picture_nearer():
    rays = some_rays(60)
    truth = render(soft_ball, rays, Hierarchical(400, 0)).colour
    seen = render(soft_ball, rays, Hierarchical(12, 40))
    assert (seen.colour - truth).abs().mean() < 0.3 * (seen.coarse.colour - truth).abs().mean()


@torch.no_grad()
def test_pixels_over_a_colour_are_what_is_rendered_over_it_in_both_passes():
    rays = some_rays(40)
    for sampling in (Hierarchical(12, 40), RayMarching(64)):
        proposal = None if isinstance(sampling, Hierarchical) else fog(0.4)
        grey, white = (
            render(soft_ball, rays, sampling, occupancy=GRID, proposal=proposal, background=background)
            for background in (0.3, 1.0)
        )
        found = white.over(torch.full((3,), 0.3))
        torch.testing.assert_close(found.colour, grey.colour)
        torch.testing.assert_close(found.coarse.colour, grey.coarse.colour)
        assert (found.coarse.colour - white.coarse.colour).abs().max() > 0.1


@pytest.mark.parametrize("stop", [0.2, 1e-2, 1e-3])
@torch.no_grad()
def test_stopping_changes_a_colour_by_less_than_the_threshold(stop):
    rays = some_rays(100)
    whole = render(soft_ball, rays, RayMarching(64, 1e-12), occupancy=GRID, differentiable=False)
    stopped = render(soft_ball, rays, RayMarching(64, stop), occupancy=GRID, differentiable=False)
    assert (stopped.colour - whole.colour).abs().max() < stop
    assert (stopped.opacity - whole.opacity).abs().max() < stop
    assert stopped.samples < whole.samples


def test_the_picture_is_the_same_with_and_without_gradients():
    rays = some_rays(50)
    with_gradients = render(soft_ball, rays, RayMarching(64, 1e-9), occupancy=GRID)
    without = render(soft_ball, rays, RayMarching(64, 1e-9), occupancy=GRID, differentiable=False)
    assert not without.colour.requires_grad
    torch.testing.assert_close(with_gradients.colour, without.colour, atol=1e-8, rtol=0)
    torch.testing.assert_close(with_gradients.depth, without.depth, atol=1e-6, rtol=0)


@pytest.mark.parametrize("sampling", PROTOCOLS)
def test_chunks_make_the_same_picture(sampling):
    rays = some_rays(37, dtype=torch.float32)
    whole = render(soft_ball, rays, sampling, differentiable=False, chunk=1000, occupancy=GRID)
    for chunk in (1, 10, 37):
        parts = render(soft_ball, rays, sampling, differentiable=False, chunk=chunk, occupancy=GRID)
        torch.testing.assert_close(parts.colour, whole.colour, atol=1e-6, rtol=0)
        torch.testing.assert_close(parts.opacity, whole.opacity, atol=1e-6, rtol=0)
        torch.testing.assert_close(parts.depth, whole.depth, atol=1e-4, rtol=0)
        assert parts.samples == whole.samples
    assert not whole.colour.requires_grad


def test_the_picture_is_the_same_by_any_number_of_threads():
    """Thread-safe fields are called by several threads, others only by the calling thread."""

    @dataclass(frozen=True)
    class Ball:
        thread_safe: bool
        callers: set[int]

        def __call__(self, points, directions):
            self.callers.add(threading.get_ident())
            return soft_ball(points, directions)

    rays = some_rays(37, dtype=torch.float32)
    before, pictures, callers = torch.get_num_threads(), [], []
    try:
        for count, safe in ((1, True), (2, True), (3, True), (3, False)):
            torch.set_num_threads(count)
            ball = Ball(safe, set())
            pictures.append(render(ball, rays, RayMarching(32), differentiable=False, chunk=8, occupancy=GRID).colour)
            callers.append(ball.callers)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(picture, pictures[0]) for picture in pictures)
    assert callers[0] == callers[3] == {threading.get_ident()}
    assert not callers[1] & callers[0]


@pytest.mark.parametrize("sampling", PROTOCOLS)
@torch.no_grad()
def test_a_ray_does_not_depend_on_other_rays(sampling):
    rays = some_rays(20)
    together = render(soft_ball, rays, sampling, occupancy=GRID).colour
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(render(soft_ball, rays[order], sampling, occupancy=GRID).colour, together[order])


@pytest.mark.parametrize("sampling", PROTOCOLS)
def test_randomness_comes_from_the_generator_alone(sampling):
    rays = some_rays(8)

    def pixels(seed):
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        return render(soft_ball, rays, sampling, occupancy=GRID, generator=generator).colour

    before = torch.random.get_rng_state()
    assert torch.equal(pixels(1), pixels(1))
    assert torch.equal(pixels(None), pixels(None))
    assert not torch.equal(pixels(1), pixels(2))
    assert torch.equal(before, torch.random.get_rng_state())


def test_the_protocol_of_the_paper_evaluates_64_and_192_samples_per_ray():
    asked = []

    def counting(points, directions):
        asked.append(len(points))
        return soft_ball(points, directions)

    seen = render(counting, some_rays(5), Hierarchical())
    assert sum(asked) == seen.samples == 5 * (64 + 64 + 128)


def test_fields_are_evaluated_with_unit_directions_at_points_on_rays():
    rays = some_rays(6)

    def field(points, directions):
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(len(directions), dtype=DOUBLE))
        ray = torch.cdist(directions, rays.directions).argmin(1)
        offset = points - rays.origins[ray]
        assert torch.linalg.cross(offset, directions).norm(dim=-1).max() < 1e-9
        return soft_ball(points, directions)

    for sampling in PROTOCOLS:
        render(field, rays, sampling, occupancy=GRID)


def test_the_proposal_renders_the_coarse_picture_and_gets_its_gradients():
    coarse = torch.tensor(0.3, dtype=DOUBLE, requires_grad=True)
    fine = torch.tensor(0.6, dtype=DOUBLE, requires_grad=True)

    def of(level):
        return lambda points, directions: (level.expand(len(points), 3), soft_ball(points, directions)[1])

    seen = render(of(fine), some_rays(9), Hierarchical(8, 16), proposal=of(coarse))
    own, _ = torch.autograd.grad(seen.colour.sum(), (fine, coarse), allow_unused=True, retain_graph=True)
    assert own > 0
    assert torch.autograd.grad(seen.colour.sum(), coarse, allow_unused=True, retain_graph=True)[0] is None
    assert torch.autograd.grad(seen.coarse.colour.sum(), coarse)[0] > 0


@pytest.mark.parametrize("background", [0.0, 0.4, 1.0])
def test_rays_that_meet_nothing_are_background(background):
    empty = Occupancy(torch.zeros(4, 4, 4, dtype=torch.bool), Sphere())
    for differentiable in (False, True):
        sampling = {"sampling": RayMarching(), "occupancy": empty, "differentiable": differentiable}
        seen = render(soft_ball, some_rays(3), background=background, **sampling)
        assert (seen.colour == background).all()
        assert (seen.opacity == 0).all()
        assert (seen.depth == 0).all()
        assert seen.samples == 0
    seen = render(fog(0.0), some_rays(3), Hierarchical(8, 8), background=background)
    torch.testing.assert_close(seen.colour, torch.full((3, 3), background, dtype=DOUBLE))


def test_no_rays_make_no_pixels():
    for sampling in PROTOCOLS:
        for differentiable in (True, False):  # at once, and in chunks
            found = render(soft_ball, some_rays(4)[:0], sampling, occupancy=GRID, differentiable=differentiable)
            assert found.colour.shape == (0, 3)


def test_marched_needs_an_occupancy():
    with pytest.raises(ValueError, match="occupancy: expected an Occupancy .* got None"):
        render(soft_ball, some_rays(2), RayMarching())


def parametric(weight, bias):
    """A small smooth network as a field of its parameters."""

    def field(points, directions):
        hidden = torch.tanh(torch.cat([points, directions], 1) @ weight + bias)
        density = torch.nn.functional.softplus(3 * torch.tanh(points @ weight[:3] + bias)[:, 0])
        return torch.sigmoid(hidden[:, :3]), density

    return field


@pytest.mark.parametrize("sampling", [Hierarchical(5, 0), Hierarchical(4, 3), RayMarching(6)])
def test_gradients_of_parameters(sampling):
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(6, 4, generator=generator, dtype=DOUBLE, requires_grad=True)
    bias = torch.randn(4, generator=generator, dtype=DOUBLE, requires_grad=True)

    def pixels(weight, bias):
        # a separate proposal, so that the fine samples do not depend on these parameters
        seen = render(parametric(weight, bias), some_rays(3), sampling, occupancy=GRID, proposal=soft_ball)
        return seen.colour, seen.opacity, seen.depth

    assert torch.autograd.gradcheck(pixels, (weight, bias))


@pytest.mark.parametrize("sampling", [Hierarchical(5, 0), RayMarching(6)])
def test_gradients_of_rays(sampling):
    rays = some_rays(3)
    generator = torch.Generator().manual_seed(1)
    field = parametric(*(torch.randn(s, generator=generator, dtype=DOUBLE) for s in ((6, 4), (4,))))

    def pixels(origins, directions):
        seen = render(field, Rays(origins, directions, rays.near, rays.far), sampling, occupancy=GRID)
        return seen.colour, seen.opacity, seen.depth

    inputs = (rays.origins.clone().requires_grad_(), rays.directions.clone().requires_grad_())
    assert torch.autograd.gradcheck(pixels, inputs)


def test_gradients_of_cameras():
    generator = torch.Generator().manual_seed(2)
    field = parametric(*(torch.randn(s, generator=generator, dtype=DOUBLE) for s in ((6, 4), (4,))))
    matrix = symmetric_intrinsics(2, 3, 0.7).double()
    straight = torch.eye(4, dtype=DOUBLE)
    straight[2, 3] = 3.0

    def pixels(turn, shift, focal):
        cross = torch.linalg.cross(turn.expand(3, 3), torch.eye(3, dtype=DOUBLE)).T
        pose = torch.eye(4, dtype=DOUBLE)
        pose = torch.cat([torch.cat([torch.matrix_exp(cross), shift[:, None]], 1), pose[3:]])
        scale = torch.stack([focal, focal, torch.ones_like(focal)])
        cameras = pinhole(matrix * scale[:, None], (pose @ straight)[None], 2, 3)
        rays = cast(cameras, torch.zeros(6, dtype=torch.long), pixel_grid(2, 3), near_far="constant")
        return render(field, rays, Hierarchical(5, 0)).colour

    turn, shift = torch.full((3,), 0.1, dtype=DOUBLE), torch.full((3,), 0.05, dtype=DOUBLE)
    inputs = (turn, shift, torch.tensor(1.1, dtype=DOUBLE))
    assert torch.autograd.gradcheck(pixels, tuple(value.requires_grad_() for value in inputs))


@pytest.mark.parametrize("sampling", PROTOCOLS)
def test_jittered_pictures_of_fog_are_those_of_fog(sampling):
    # with constant density, jitter within intervals does not change the dense protocols
    rays = some_rays(20)
    still = render(fog(0.7), rays, sampling, occupancy=GRID)
    jittered = render(fog(0.7), rays, sampling, occupancy=GRID, generator=torch.Generator().manual_seed(0))
    slack = 0.7 * 2 / 64 if isinstance(sampling, RayMarching) else 1e-9
    assert (still.opacity - jittered.opacity).abs().max() < slack


def test_a_proposal_covers_the_whole_length_of_each_ray():
    # rays with n = 1, 2, 3 and 8 samples in fog: the proposal has the opacity 1 - exp(-sigma n step)
    count, step = torch.tensor([1, 2, 3, 8]), 2 / 20
    straight = torch.tensor([[0.0, 0.0, 1.0]], dtype=DOUBLE).expand(4, 3)
    start = torch.tensor([[0.0, 0.0, -0.9]], dtype=DOUBLE).expand(4, 3)
    rays = Rays(start, straight, torch.zeros(4, dtype=DOUBLE), count.double() * step - step / 4)
    asked = []

    def proposal(points, directions):
        asked.append(len(points))
        return fog(0.9)(points, directions)

    seen = render(fog(0.5), rays, RayMarching(20), occupancy=GRID, proposal=proposal, background=0.0)
    assert asked == [1 + 1 + 2 + 4]
    opacity = 1 - torch.exp(-0.9 * count * step)
    torch.testing.assert_close(seen.coarse.colour[:, 0], 0.2 * opacity.double())


class SplitBall:
    """A soft ball with scaled density, whose colours are evaluated after densities, counting coloured points."""

    def __init__(self, share):
        self.share, self.coloured, self.calls = share, 0, 0

    def __call__(self, points, directions):
        return self.colour_of(points, directions), self.density_of(points)

    def hidden(self, points):
        return points

    def density_of(self, hidden):
        return self.share * soft_ball(hidden, hidden)[1]

    def colour_of(self, hidden, directions):
        self.coloured, self.calls = self.coloured + len(hidden), self.calls + 1
        return soft_ball(hidden, directions)[0]


def test_colours_of_all_rounds_are_evaluated_in_one_call():
    split, called = SplitBall(0.1), []
    render(split, some_rays(300), RayMarching(96, 1e-3), occupancy=GRID, differentiable=False, chunk=1000)
    called.append(split.calls)
    render(split, some_rays(3), RayMarching(96, 1e-3), occupancy=GRID, differentiable=False, chunk=1000)
    called.append(split.calls - called[0])
    assert called == [2, 1]  # one call for each part of the rays: two parts, and one


class Rows(list):
    """A list that is indexed by a tensor of indices."""

    def __getitem__(self, chosen):
        return Rows(list.__getitem__(self, index) for index in chosen.tolist())


class Unjoined(SplitBall):
    """A field whose hidden values can be indexed, but not concatenated."""

    def hidden(self, points):
        return Rows(points)

    def density_of(self, hidden):
        return super().density_of(torch.stack(list(hidden)))

    def colour_of(self, hidden, directions):
        return super().colour_of(torch.stack(list(hidden)), directions)


def test_colours_of_values_that_cannot_be_concatenated_are_evaluated_by_batch():
    rays, sampling, split = some_rays(300), RayMarching(96, 1e-3), Unjoined(0.1)
    expected = render(SplitBall(0.1), rays, sampling, occupancy=GRID, differentiable=False)
    found = render(split, rays, sampling, occupancy=GRID, differentiable=False)
    torch.testing.assert_close(found.colour, expected.colour)
    assert split.calls > 2


@pytest.mark.parametrize("share", [1.0, 0.02])
def test_colours_of_samples_with_small_weights_are_not_evaluated(share):
    # Another implementation: the field as a plain function, all of whose colours are evaluated; haze has equal weights.
    rays, split = some_rays(300), SplitBall(share)
    plain = render(lambda *given: split(*given), rays, RayMarching(96, 1e-3), occupancy=GRID, differentiable=False)
    split.coloured = 0
    found = render(split, rays, RayMarching(96, 1e-3), occupancy=GRID, differentiable=False)
    error = found.colour - plain.colour
    assert error.abs().max() < 0.05 * 0.25  # the omitted weight times the largest deviation of its colour
    torch.testing.assert_close(found.opacity, plain.opacity)
    torch.testing.assert_close(found.depth, plain.depth)
    assert found.samples == plain.samples
    assert 0 < split.coloured < 0.9 * plain.samples


@torch.no_grad()
def test_a_stopped_ray_is_opaque_with_the_colour_of_its_samples():
    # Closed form: fog with one colour in front of black, of which rays that continue have a small part.
    rays = some_rays(30)
    stopped = render(fog(20.0), rays, RayMarching(64, 0.2), occupancy=GRID, differentiable=False, background=0.0)
    opaque = stopped.opacity > 1 - 1e-5
    assert opaque.any()
    assert (stopped.opacity[~opaque] <= 0.8).all()
    expected = torch.tensor([0.2, 0.4, 0.6]).to(stopped.colour).expand(int(opaque.sum()), 3)
    torch.testing.assert_close(stopped.colour[opaque], expected)


@pytest.mark.parametrize("split", [False, True])
@torch.no_grad()
def test_pictures_evaluate_every_second_sample_and_others_where_needed(split):
    # Closed form: fog in a ball of radius 0.5, compared with every second and with every sample of the rays.
    class Fog(SplitBall):
        def density_of(self, hidden):
            return 8.0 * (hidden.norm(dim=-1) < 0.5)

    rays, field = some_rays(300), Fog(1.0)
    middle = -(rays.origins * rays.directions).sum(1)
    chord = 2 * (0.25 - rays.at(middle).square().sum(1)).clamp_min(0).sqrt()
    expected = 1 - torch.exp(-8 * chord)
    clear = (expected > 0) & (expected < 0.95)
    errors, samples = [], []
    for steps, stop in ((128, EXACT), (128, 2 * EXACT), (64, EXACT)):
        field_or_function = field if split else lambda *given: field(*given)
        found = render(field_or_function, rays, RayMarching(steps, stop), occupancy=GRID, differentiable=False)
        errors.append(float((found.opacity - expected)[clear].square().mean()))
        samples.append(found.samples)
    exact, ours, longer = errors
    assert samples[1] < 0.7 * samples[0]
    assert ours < 1.2 * exact
    assert ours < 0.6 * longer


@torch.no_grad()
def test_a_threshold_of_zero_never_stops():
    rays = some_rays(30)
    whole = render(fog(50.0), rays, RayMarching(64, 0.0), occupancy=GRID, differentiable=False)
    assert whole.samples == len(march(rays, GRID, 2 / 64))
    stopped = render(fog(50.0), rays, RayMarching(64, 1e-3), occupancy=GRID, differentiable=False)
    torch.testing.assert_close(whole.colour, stopped.colour, atol=1e-3, rtol=0)


def test_chunks_keep_the_coarse_picture():
    rays = some_rays(11)
    whole = render(soft_ball, rays, Hierarchical(8, 4))
    parts = render(soft_ball, rays, Hierarchical(8, 4), differentiable=False, chunk=4)
    torch.testing.assert_close(parts.coarse.colour, whole.coarse.colour)


def test_a_lambda_and_a_kornia_camera_make_a_picture():
    # Closed form: fog of density 0.7 in the unit sphere, at every pixel 1 - exp(-sigma length of the ray in it).
    cameras = ring(2, (9, 7))
    bare = PinholeCamera(cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width)
    pictures = hyperplanes.render(
        lambda points, directions: (torch.zeros_like(points), torch.full(points.shape[:1], 0.7)), bare
    )
    rays = clipped(cameras)
    expected = 1 - torch.exp(-0.7 * (rays.far - rays.near))
    assert pictures.images.shape == (2, 3, 9, 7)
    torch.testing.assert_close(pictures.opacity.flatten(), expected, atol=0.7 / 160, rtol=0)
    torch.testing.assert_close(pictures.images[:, 0].flatten(), 1 - expected, atol=0.7 / 160, rtol=0)


@pytest.mark.parametrize("sampling", PROTOCOLS)
def test_pixels_of_a_picture_agree_with_its_rays(sampling):
    cameras, bounds = ring(1, (6, 5)), Sphere((0.1, 0.0, -0.1), 0.9)
    picture = render(soft_ball, cameras, sampling, bounds=bounds, background=0.3, antialias=False)
    rays = cast(cameras, torch.zeros(30, dtype=torch.long), pixel_grid(6, 5), bounds, near_far=sampling.near_far)
    seen = render(soft_ball, rays, sampling, bounds=bounds, background=0.3, differentiable=False)
    torch.testing.assert_close(picture.images[0].flatten(1).T, seen.colour)
    torch.testing.assert_close(picture.depth.flatten(), seen.depth)
    assert picture.samples == seen.samples


def test_rays_without_bounds_are_rendered_by_the_sampler_of_the_paper():
    rays = some_rays(4)
    assert torch.equal(render(soft_ball, rays).colour, render(soft_ball, rays, Hierarchical()).colour)
    marched = render(soft_ball, rays, bounds=Sphere()).colour
    assert torch.equal(marched, render(soft_ball, rays, RayMarching(), occupancy=full(Sphere(), 1)).colour)


@pytest.mark.parametrize("sampling", PROTOCOLS)
def test_pictures_keep_gradients_on_request(sampling):
    level = torch.tensor(0.5, requires_grad=True)

    def field(points, directions):
        return level.expand(len(points), 3), soft_ball(points, directions)[1]

    assert not render(field, ring(1), sampling).images.requires_grad
    render(field, ring(1), sampling, differentiable=True).images.sum().backward()
    assert level.grad > 0


def test_a_field_with_values_of_another_shape_is_named():
    with pytest.raises(
        ValueError, match=r"field: expected colours \(\d+, 3\) and densities \(\d+,\), got .* and \(\d+, 1\)"
    ):
        render(lambda points, _: (points, points[:, :1]), ring(1))


def test_properties_of_samplers():
    for sampling in PROTOCOLS:
        assert isinstance(sampling, Sampler)
    assert RayMarching(60, 0.1).for_rendering(100) == RayMarching(100, 0.1)
    assert (
        RayMarching(60, 0.01).for_rendering(400) == RayMarching(200, 0.04) == RayMarching(60, 0.01).for_rendering(1e6)
    )
    assert Hierarchical(3, 4).for_rendering(100) == Hierarchical(3, 4)
    assert RayMarching().needs_occupancy
    assert not Hierarchical().needs_occupancy
