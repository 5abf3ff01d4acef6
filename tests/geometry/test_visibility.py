"""Source of truth: the depth of a ball in closed form, and loops over points, views and steps."""

import math
from dataclasses import replace
from threading import Thread

import pytest
import torch

import hyperplanes.geometry.visibility.first_hits as first_hits_module
from hyperplanes.adaptation.baselines.hull_blend import blend_views
from hyperplanes.geometry import Sphere, carve, cast
from hyperplanes.geometry.cameras import centres, concatenate, projection_matrices
from hyperplanes.geometry.chosen_views import (
    BORDER_MARGIN,
    BORDER_PENALTY,
    BORDER_POLE,
    INVISIBLE_PENALTY,
    MAX_DEPTH_PENALTY,
    OPAQUE_MASK,
    PARTIAL_MASK_PENALTY,
    PENALTY_RADIANS,
    Penalties,
)
from hyperplanes.geometry.distortion import distorted, distorted_pixels
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.rays import pixel_grid
from hyperplanes.geometry.visibility import planes as module
from hyperplanes.geometry.visibility.first_hits import first_hits
from hyperplanes.geometry.visibility.penalties import fading, margins
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from tests.reference_rendering import ball_views, camera_at, ring

SIZE = (20, 24)


def ball(radius=0.5, side=64):
    """A grid whose occupied voxels have their centres in a ball around the origin."""
    whole = full(Sphere(), side)
    inside = whole.centres().norm(dim=1) < radius
    return Occupancy(inside.reshape(side, side, side), Sphere())


def planes(cameras=None):
    """Views of a ball. With the default cameras, the lower border of the last view cuts the ball."""
    cutting = camera_at((1.5, 0.5, 2.5), SIZE, target=(0.0, 0.8, 0.0))
    views = ball_views(cameras or concatenate([ring(4, SIZE), cutting]))
    return VisibilityPlanes(views.images, views.cameras, views.masks, carve(views.masks, views.cameras, Sphere(), 32))


def queries(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * 2.4  # some of them outside the pictures
    return points, torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def test_the_depth_of_a_ball_is_that_in_closed_form():
    cameras = ring(3, SIZE)
    found = first_hits(ball(), cameras)
    pixels = pixel_grid(*SIZE)
    for view in range(3):
        rays = cast(cameras, torch.full((len(pixels),), view), pixels, Sphere(radius=0.5))
        hit = (rays.far - rays.near) > 0.2  # no rays that are almost tangent
        error = found[view].flatten()[hit] - rays.near[hit]
        assert error.abs().max() < 2 / 64 + 1 / 128  # a voxel plus half a step


def test_rays_without_a_voxel_end_at_the_far_side_of_the_sphere_and_masked_ones_are_not_followed():
    cameras = camera_at((0.0, 0.0, 3.0), SIZE)
    empty = Occupancy(torch.zeros(8, 8, 8, dtype=torch.bool), Sphere())
    rays = cast(cameras, torch.zeros(SIZE[0] * SIZE[1], dtype=torch.long), pixel_grid(*SIZE))
    torch.testing.assert_close(first_hits(empty, cameras)[0].flatten(), rays.far)
    masked = first_hits(ball(), cameras, torch.zeros(1, 1, *SIZE))
    torch.testing.assert_close(masked, torch.full((1, *SIZE), 4.0))


def skewed(cameras):
    """Cameras with skew."""
    cameras.intrinsics[:, 0, 1], cameras.intrinsics[:, 1, 1] = 3.0, cameras.intrinsics[:, 1, 1] * 1.4
    return cameras


@pytest.mark.parametrize(
    "cameras",
    [
        ring(4, SIZE),
        concatenate([camera_at((0.1, 0.7, 0.2), SIZE), camera_at((0.0, 0.0, 9.0), SIZE)]),  # one is inside the scene
        skewed(ring(3, SIZE)),
        distorted(ring(3, SIZE), torch.tensor([[-0.4, 0.1, 0.01, -0.02, 0.0]])),
    ],
    ids=["around", "inside", "skewed", "distorted"],
)
def test_kernel_and_plain_pytorch_find_the_same_depth(monkeypatch, cameras):
    masks = torch.rand(cameras.batch_size, 1, *SIZE, generator=torch.Generator().manual_seed(0)) - 0.1
    grid = Occupancy(ball(side=16).occupied, Sphere((0.1, -0.2, 0.05), 1.1))
    compiled = first_hits(grid, cameras, masks)
    monkeypatch.setattr(first_hits_module, "find_spec", lambda name: None)
    plain = first_hits(grid, cameras, masks)
    assert plain.unique().numel() > 20
    assert (compiled - plain).abs().gt(1e-5).float().mean() < 2e-3  # samples may round to either voxel


def slow_penalties(shown, points, hidden=()):
    """Direction, depth, coverage and penalty of every view at every point, in loops."""
    matrices, eyes = projection_matrices(shown.colours.cameras), centres(shown.colours.cameras)
    height, width = SIZE
    rows = []
    for point in points:
        for view in range(len(shown)):
            offset = point - eyes[view]
            direction, distance = offset / offset.norm(), float(offset.norm())
            u, v, w = (matrices[view] @ torch.cat([point, torch.ones(1)])).tolist()
            inside = w > 1e-3 and -0.01 <= u / w <= width - 0.99 and -0.01 <= v / w <= height - 0.99
            if not inside or view in hidden:
                rows.append([*direction.tolist(), 0.0, 1.0, INVISIBLE_PENALTY])
                continue
            u, v = min(max(u / w, 0), width - 1), min(max(v / w, 0), height - 1)
            column, row = min(int(u), width - 2), min(int(v), height - 2)
            corners = shown.depth_opacity[view, row : row + 2, column : column + 2]
            top = corners[0, 0] * (1 - u + column) + corners[0, 1] * (u - column)
            low = corners[1, 0] * (1 - u + column) + corners[1, 1] * (u - column)
            depth, opacity = (top * (1 - v + row) + low * (v - row)).tolist()
            behind = distance - depth
            penalty = min(max(behind - shown.tolerance, -MAX_DEPTH_PENALTY), MAX_DEPTH_PENALTY) + (
                PARTIAL_MASK_PENALTY if opacity < OPAQUE_MASK else 0
            )
            cut = 1 - (height - 1 - v) / (BORDER_MARGIN * height)
            if view == len(shown) - 1 and cut > 0:
                penalty = max(penalty, 0) + BORDER_PENALTY * cut / (BORDER_POLE - cut)
            rows.append([*direction.tolist(), behind, opacity, penalty])
    return torch.tensor(rows).reshape(len(points), len(shown), 6)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_chosen_views_are_those_of_the_definition(monkeypatch, compiled):
    shown, (points, directions) = planes().mask_views(torch.tensor([2])), queries(60)
    if not compiled:
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    found = shown.choose(points, directions, best=3, nearest=2)
    every = slow_penalties(shown, points, hidden=(2,))
    angle = torch.acos((every[..., :3] * directions[:, None]).sum(-1).clamp(-1, 1))
    score = angle + PENALTY_RADIANS * every[..., 5].clamp_min(0)
    for chosen, order in ((found.best, every[..., 5]), (found.nearest, score)):
        values = torch.cat([chosen.directions, torch.stack([chosen.behind, chosen.coverage, chosen.penalty], -1)], -1)
        torch.testing.assert_close(
            values, every.gather(1, chosen.views[..., None].expand(-1, -1, 6)), atol=2e-5, rtol=0
        )
        assert all(len(set(row)) == 3 for row in chosen.views.tolist())  # three different views
        least = order.sort(1).values[:, :3]
        torch.testing.assert_close(order.gather(1, chosen.views), least, atol=1e-4, rtol=0)
    unseen = every[..., 5] == INVISIBLE_PENALTY
    assert unseen[:, 2].all()
    assert 0.2 < unseen.float().mean() < 0.8  # some are seen, some are not
    torch.testing.assert_close(found.coverage, every[..., 4].amin(1), atol=1e-5, rtol=0)
    assert torch.equal(found.number, (~unseen).sum(1).float())
    assert torch.equal(found.best.valid, ~unseen.gather(1, found.best.views))


@pytest.mark.parametrize("compiled", [True, False])
def test_where_penalties_are_equal_occlusion_decides_alike(monkeypatch, compiled):
    """Points of the surface that each view sees, and that other views see, see from behind or see at an edge."""
    offsets = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.4])
    shown = planes(ring(5, SIZE)).with_penalty_offsets(offsets)
    if not compiled:
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    view, row, column = (shown.depth_opacity[..., 1] == 1).nonzero().unbind(1)
    pixels = torch.stack([column, row], 1).float()
    points = cast(shown.colours.cameras, view, pixels, Sphere()).at(shown.depth_opacity[view, row, column, :1])[:, 0]
    seen = shown.with_penalties(Penalties.binary()).choose(points, best=len(shown)).best
    hidden, valid = (seen.behind > shown.tolerance) | (seen.coverage < OPAQUE_MASK), seen.penalty < INVISIBLE_PENALTY
    assert 0.1 < hidden[valid].float().mean() < 0.9  # some are hidden, some are not
    expected = hidden.float() + offsets[seen.views]
    clear = (seen.behind - shown.tolerance).abs() > 1e-5
    torch.testing.assert_close(seen.penalty[valid & clear], expected[valid & clear])


@pytest.mark.parametrize("compiled", [True, False])
def test_blended_colours_are_those_of_the_unstructured_lumigraph(monkeypatch, compiled):
    shown, (points, directions) = planes(), queries(40)
    if not compiled:
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    every = slow_penalties(shown, points)
    angle = torch.acos((every[..., :3] * directions[:, None]).sum(-1).clamp(-1, 1))
    score, order = (angle + PENALTY_RADIANS * every[..., 5].clamp_min(0)).clamp_min(1e-2).sort(1)
    weights = (1 / score[:, :2] - 1 / (1.01 * score[:, 2:3])).clamp_min(1e-6)
    colours = shown.colours.lookup(points).colours.gather(1, order[:, :2, None].expand(-1, -1, 3))
    expected = (weights[..., None] * colours).sum(1) / weights.sum(1, keepdim=True)
    torch.testing.assert_close(blend_views(shown, points, directions, 2), expected, atol=2e-3, rtol=0)


def test_a_border_cuts_an_object_if_enough_of_its_pixels_are_set():
    """At least two pixels and a fiftieth of the shorter side are needed: four pixels of a picture of 200 x 400."""
    masks = torch.zeros(7, 1, 40, 60)
    masks[1, 0, 5:35, 10:50] = 1  # nothing is cut
    masks[2, 0, 0, 0] = 1  # one pixel at two borders
    masks[3, 0, 10:12, 0] = 1  # two pixels at the left border
    masks[4, 0, :, -1] = 0.97  # all of the right border, with partial coverage
    masks[5, 0, 20:, 30:] = 1  # at the right and the lower border
    masks[6] = 1
    cut = torch.tensor(
        [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 1], [1, 1, 1, 1]]
    )
    torch.testing.assert_close(margins(masks), BORDER_MARGIN * 40 * cut)
    large = torch.zeros(2, 1, 200, 400)
    large[0, 0, 0, :3], large[1, 0, 0, :4] = 1, 1
    torch.testing.assert_close(margins(large), BORDER_MARGIN * 200 * torch.tensor([[0, 0, 0, 0], [0, 0, 1, 0]]))


def test_penalties_grow_over_the_margins_of_borders_that_cut_the_object():
    """By hand, for 41 x 61 pixels: at the left border, halfway, beyond the margin, at the lower and right borders."""
    margin = BORDER_MARGIN * 41
    pixels = torch.tensor([[0.0, 20.0], [margin / 2, 20.0], [margin + 1, 20.0], [30.0, 40.0], [60.0, 20.0]])
    coordinates = (pixels / torch.tensor([60.0, 40.0]) * 2 - 1)[:, None].expand(-1, 2, 2)
    found = fading(torch.tensor([[margin, 0, 0, margin], [0, 0, 0, 0]]), coordinates, (41, 61))
    torch.testing.assert_close(found, torch.tensor([[1.0, 0], [0.5, 0], [0, 0], [1, 0], [0, 0]]), atol=1e-5, rtol=0)
    beyond = torch.full((1, 1, 2), 1 + 1e-6)  # as lookups do by rounding
    assert float(fading(torch.zeros(1, 4), beyond, (41, 61))) == 0


def test_the_margin_is_measured_where_the_lens_shows_a_point():
    pinholes = concatenate([ring(4, SIZE), camera_at((1.5, 0.5, 2.5), SIZE, target=(0.0, 0.8, 0.0))])
    cameras = distorted(pinholes, torch.tensor([0.4, 0.0, 0.0, 0.0, 0.0]))
    views, (points, _) = ball_views(cameras), queries(500)
    given = views.images, views.cameras, views.masks, ball()
    fading_out, whole = VisibilityPlanes(*given), VisibilityPlanes(*given)
    whole._view_penalties = replace(whole._view_penalties, margins=torch.zeros_like(whole._view_penalties.margins))
    found, plain = (_penalties_of(each.choose(points, best=5).best, 4) for each in (fading_out, whole))
    # by hand: the row in which the lens shows the point, and its position in the margin of the lower border
    matrix = projection_matrices(pinholes)[4]
    ideal = points @ matrix[:, :3].T + matrix[:, 3]
    ideal = (ideal[:, :2] / ideal[:, 2:])[:, None].expand(-1, 5, -1)
    row = distorted_pixels(cameras, ideal)[0][:, 4, 1].clamp(0, SIZE[0] - 1)
    cut = 1 - (SIZE[0] - 1 - row) / (BORDER_MARGIN * SIZE[0])
    expected = torch.where(cut > 0, plain.clamp_min(0) + BORDER_PENALTY * cut / (BORDER_POLE - cut), plain)
    expected = torch.where(plain == INVISIBLE_PENALTY, INVISIBLE_PENALTY, expected)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
    assert ((cut > 0) & (plain < INVISIBLE_PENALTY)).sum() > 10  # some lie in the margin


def _penalties_of(chosen, view):
    """The penalties of one view, where all views were chosen."""
    return chosen.penalty[chosen.views == view]


def test_a_point_on_a_ball_is_visible_from_its_side_and_hidden_from_the_opposite_side():
    views = ball_views(ring(12, (64, 64)))
    shown = VisibilityPlanes(views.images, views.cameras, views.masks, ball())
    normal = torch.nn.functional.normalize(centres(views.cameras)[4] + 0.1, dim=0)
    found = shown.choose(0.48 * normal[None], best=12).best
    facing = (centres(views.cameras)[found.views[0]] / 3) @ normal
    for behind, cosine in zip(found.behind[0].tolist(), facing.tolist(), strict=True):
        if cosine > 0.5:
            assert abs(behind) < 0.1
        if cosine < -0.5:
            assert behind == pytest.approx(2 * 0.48 * -cosine, abs=0.15)
    assert facing[0] > 0.3  # the best view is on the point's side
    assert found.penalty[0].tolist() == sorted(found.penalty[0].tolist())


def test_depths_of_the_hull_are_computed_once_and_only_if_opacities_do_not_suffice(monkeypatch):
    computed = []

    def counted(*given):
        computed.append(given)
        return first_hits(*given)

    monkeypatch.setattr(module, "first_hits", counted)
    shown = planes()
    points, directions = queries(50)
    coverage = shown.choose(points, best=0).coverage
    by_surface = shown.with_surface(ball(side=32))
    by_surface.choose(points, directions, best=0, nearest=2)
    assert len(computed) == 1  # that of the surface
    copies = [shown.with_penalties(Penalties.binary()), shown.with_penalty_offsets(torch.zeros(len(shown))), by_surface]
    for each in (shown, *copies):
        torch.testing.assert_close(each.choose(points, best=2).coverage, coverage)
    assert len(computed) == 2


def test_without_masks_all_pixels_count_as_opaque():
    views = ball_views(ring(3, SIZE), masks=False)
    shown = VisibilityPlanes(views.images, views.cameras, None, full(Sphere(), 4))
    found = shown.choose(torch.zeros(1, 3), best=3)
    assert torch.equal(found.coverage, torch.ones(1))
    assert math.isclose(float(found.best.behind[0, 0]), 1.0, abs_tol=0.02)  # the centre's depth


@pytest.mark.parametrize("compiled", [True, False])
def test_the_nearest_views_depend_on_the_given_surface_and_the_best_on_the_hull(monkeypatch, compiled):
    """With the ball's surface, planes whose hull fills the scene choose the views that the ball's planes choose."""
    views, (points, directions) = ball_views(ring(5, SIZE)), queries(60)
    if not compiled:
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    loose, tight = (
        VisibilityPlanes(views.images, views.cameras, views.masks, grid) for grid in (full(Sphere(), 64), ball())
    )
    hidden = torch.tensor([2])
    wanted = loose.with_surface(ball()).mask_views(hidden).choose(points, directions, best=3, nearest=2)
    by_hull, by_ball = (
        each.mask_views(hidden).choose(points, directions, best=3, nearest=2) for each in (loose, tight)
    )
    assert not torch.equal(by_hull.nearest.behind, by_ball.nearest.behind)
    for found, expected in ((wanted.nearest, by_ball.nearest), (wanted.best, by_hull.best)):
        assert torch.equal(found.views, expected.views)
        torch.testing.assert_close(found.behind, expected.behind)
        torch.testing.assert_close(found.penalty, expected.penalty)
    assert torch.equal(wanted.number, by_hull.number)
    without = loose.with_surface(ball()).mask_views(hidden).choose(points, directions, best=0, nearest=2)
    assert without.best.views.shape == (60, 0)
    assert torch.equal(without.nearest.views, wanted.nearest.views)
    for name in ("coverage", "number"):
        torch.testing.assert_close(getattr(without, name), getattr(wanted, name), atol=0, rtol=0)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_points_that_are_not_finite_are_seen_by_no_view_and_do_not_change_others(monkeypatch, compiled, value):
    if not compiled:
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    shown, (points, directions) = planes(), queries(600)
    expected = shown.choose(points, directions, best=3, nearest=2)
    spoiled, other = points.clone(), torch.arange(600) % 5 > 0
    spoiled[~other, 1] = value
    torch.full((600, 20), 2**40).sum()  # so that uninitialised memory holds invalid indices
    for given in ((spoiled, directions), (points, directions + spoiled - points)):
        found = shown.choose(*given, best=3, nearest=2)
        for part, clean in ((found.best, expected.best), (found.nearest, expected.nearest)):
            assert part.views.min() >= 0
            assert part.views.max() < len(shown)
            for name in ("views", "behind", "coverage", "penalty"):
                torch.testing.assert_close(getattr(part, name)[other], getattr(clean, name)[other], rtol=0, atol=0)
    assert not shown.choose(spoiled, directions, best=3).number[~other].any()


def test_rays_end_whose_step_is_lost_to_rounding():
    far = camera_at((0.0, 0.0, 1e6), SIZE)
    far.intrinsics[:, :2, :2] *= 1e6 / 3
    depths = []
    worker = Thread(target=lambda: depths.append(first_hits(ball(side=16), far)), daemon=True)
    worker.start()
    worker.join(30)
    assert depths, "still stepping"
    assert depths[0].min() >= 1e6 - 1


def test_planes_made_in_inference_mode_can_be_used_outside_it():
    points, directions = queries(50)
    with torch.inference_mode():
        made = planes()
    torch.testing.assert_close(made.depth_opacity, planes().depth_opacity)
    found = made.choose(points, directions, best=2, nearest=2)
    torch.testing.assert_close(found.coverage, planes().choose(points, best=2).coverage)


def test_under_a_transform_depths_of_constant_planes_are_computed_once(monkeypatch):
    computed, (points, directions) = [], queries(20)

    def counted(*given):
        computed.append(given)
        return first_hits(*given)

    monkeypatch.setattr(module, "first_hits", counted)
    shown = planes()

    def score(scale):
        return scale * sum(shown.choose(points, directions, best=2, nearest=2).coverage.sum() for _ in range(3))

    torch.func.grad(score)(torch.tensor(2.0))
    assert len(computed) == 1
    torch.testing.assert_close(shown.depth_opacity, planes().depth_opacity)


def test_a_hull_is_carved_and_its_depth_found_under_transforms():
    views = ball_views(ring(3, SIZE))

    def both(scale):
        hull = carve(views.masks, views.cameras, Sphere(), 16)
        return scale * first_hits(hull, views.cameras).sum(), (hull.occupied.sum(), scale)

    _, (count, _) = torch.func.grad(both, has_aux=True)(torch.tensor(2.0))
    assert int(count) == int(carve(views.masks, views.cameras, Sphere(), 16).occupied.sum())


def test_cameras_that_are_changed_in_place_have_their_new_poses():
    """The kernels choose the views that plain PyTorch chooses, which reads the cameras at each call."""
    shown, (points, directions) = planes(ring(4, SIZE)), queries(200)
    before = shown.choose(points, directions, best=2, nearest=2).best.views
    poses = shown.colours.cameras.extrinsics
    poses.copy_(poses.roll(1, 0))
    found = shown.choose(points, directions, best=2, nearest=2)
    expected = module.choose_torch(shown, points, directions, 2, 3, shown.depth_opacity)
    assert (found.best.views == expected.best.views).float().mean() > 0.99  # ties
    assert (found.nearest.views == expected.nearest.views).float().mean() > 0.99
    assert not torch.equal(found.best.views, before)
