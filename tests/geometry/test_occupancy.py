"""Source of truth: a loop (tests/reference.py), and shapes with exactly known silhouettes."""

import itertools
import math

import numpy as np
import pytest
import torch

from hyperplanes.geometry import Sphere, cameras, carve, cast, occupancy
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.rays import pixel_grid
from tests import reference


def pictures(hits, ours, size, centre=(0.0, 0.0, 0.0)):
    """Exact masks: a pixel is set if `hits(origins, directions)` is true for any of the rays through it."""
    masks = []
    for view in range(ours.batch_size):
        rays = cast(ours, torch.full((size * size,), view), pixel_grid(size, size))
        masks.append(hits(rays.origins - torch.tensor(centre), rays.directions).reshape(1, size, size))
    return torch.stack(masks).float()


def ball(radius):
    def hits(origins, directions):
        along = (origins * directions).sum(-1)
        return origins.square().sum(-1) - along.square() < radius**2

    return hits


def box(half):
    def hits(origins, directions):
        first, second = (-half - origins) / directions, (half - origins) / directions
        return torch.minimum(first, second).amax(-1) < torch.maximum(first, second).amin(-1)

    return hits


@pytest.mark.parametrize("side", [7, 24, 48])
@pytest.mark.parametrize("shape", ["ball", "box"])
@pytest.mark.parametrize("size", [9, 40])
def test_the_hull_contains_the_object(side, shape, size):
    """Property: every voxel that intersects the object is kept, also for coarse grids and coarse pictures."""
    ours = cameras.pinhole(cameras.symmetric_intrinsics(size, size, 0.9), cameras.fibonacci_sphere(12, 2.7), size, size)
    masks = pictures(ball(0.5) if shape == "ball" else box(0.35), ours, size)
    hull = carve(masks, ours, Sphere(), side)
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    solid = points.norm(dim=-1) < 0.5 if shape == "ball" else points.abs().amax(-1) < 0.35
    assert hull.contains(points[solid]).all()
    if side == 48 and size == 40:  # a ball of radius 0.5 fills 6.5 % of the cube
        assert hull.occupied.float().mean() < 0.2


@pytest.mark.parametrize("votes", [2, 3])
@pytest.mark.parametrize("compiled", [True, False])
def test_fewer_wrong_masks_than_votes_remove_nothing(votes, compiled, monkeypatch):
    """Property: if fewer than `votes` masks are empty by mistake, the whole object is kept."""
    if not compiled:
        monkeypatch.setattr(occupancy, "find_spec", lambda name: None)
    ours = cameras.pinhole(cameras.symmetric_intrinsics(30, 30, 0.9), cameras.fibonacci_sphere(12, 2.7), 30, 30)
    masks = pictures(ball(0.5), ours, 30)
    damaged = masks.clone()
    damaged[[0, 5, 7][: votes - 1]] = 0
    points = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert not carve(damaged, ours, Sphere(), 20).occupied.any()
    hull = carve(damaged, ours, Sphere(), 20, votes)
    assert hull.contains(0.49 * points).all()
    assert not hull.contains(0.98 * points).all()
    ruled = sum(
        (~carve(damaged[[view]], cameras.select(ours, [view]), Sphere(), 20).occupied).int() for view in range(12)
    )
    torch.testing.assert_close(hull.occupied, ruled < votes)  # brute force: one vote per view


def test_parts_of_the_object_outside_the_pictures_are_kept():
    """Property: a picture does not rule out voxels that it does not show."""
    ours = cameras.pinhole(cameras.symmetric_intrinsics(30, 30, 0.3), cameras.fibonacci_sphere(9, 2.7), 30, 30)
    hull = carve(pictures(ball(0.3), ours, 30, (0.35, 0.0, 0.0)), ours, Sphere(), 20)
    points = torch.randn(5000, 3, generator=torch.Generator().manual_seed(0))
    points = 0.3 * points / points.norm(dim=-1, keepdim=True) + torch.tensor([0.35, 0.0, 0.0])
    assert hull.contains(points).all()
    assert hull.occupied.float().mean() < 0.9


def test_a_line_is_kept_where_all_masks_show_it():
    """Property: parts of a line are kept if their pixels are set, and removed at a pixel that one mask misses."""
    ours = cameras.pinhole(cameras.symmetric_intrinsics(40, 40, 0.9), cameras.fibonacci_sphere(12, 2.7), 40, 40)
    wire = torch.linspace(-0.6, 0.6, 4000)[:, None] * torch.tensor([[0.7, 0.5, -0.5]])
    pixels = ours.project(wire.expand(12, -1, 3)).round().long()
    masks = torch.zeros(12, 1, 40, 40)
    for mask, pixel in zip(masks, pixels, strict=True):
        mask[0, pixel[:, 1], pixel[:, 0]] = 1
    hull = carve(masks, ours, Sphere(), 48)
    assert hull.contains(wire).all()
    assert hull.occupied.float().mean() < 0.02
    column, row = pixels[0, 2000].tolist()
    masks[0, 0, row - 3 : row + 4, column - 3 : column + 4] = 0
    cut = ~carve(masks, ours, Sphere(), 48).contains(wire)
    assert cut[2000]
    hidden = (pixels[0] - pixels[0, 2000]).abs().amax(1) <= 3
    assert not cut[~hidden].any()


def test_the_kernel_and_plain_pytorch_carve_the_same_hull(monkeypatch):
    ours = cameras.pinhole(cameras.symmetric_intrinsics(33, 33, 0.8), cameras.fibonacci_sphere(7, 2.2), 33, 33)
    masks = pictures(box(0.4), ours, 33, (0.1, 0.0, -0.1))
    fast = carve(masks, ours, Sphere((0.05, 0.0, 0.0), 0.9), 30).occupied
    monkeypatch.setattr("hyperplanes.geometry.occupancy.find_spec", lambda name: None)
    plain = carve(masks, ours, Sphere((0.05, 0.0, 0.0), 0.9), 30).occupied
    assert (fast != plain).float().mean() < 1e-3  # rounding may decide about a voxel at the edge of a pixel
    assert 0.05 < plain.float().mean() < 0.5


def test_the_hull_is_within_that_of_the_loop():
    """The loop uses a slightly larger footprint of a voxel, so its hull contains that of the product."""
    ours = cameras.pinhole(cameras.symmetric_intrinsics(24, 24, 0.9), cameras.fibonacci_sphere(6, 2.7), 24, 24)
    masks = pictures(ball(0.4), ours, 24, (0.1, -0.2, 0.0))
    hull = carve(masks, ours, Sphere(), 10)
    everything = full(Sphere(), 10).centres().numpy()
    slow = reference.hull(
        masks[:, 0].numpy() > 0, cameras.projection_matrices(ours).numpy(), everything, 0.1 * math.sqrt(3)
    )
    ours_kept = hull.occupied.flatten().numpy()
    assert not (ours_kept & ~slow).any()
    assert slow.mean() < 0.95


def test_the_hull_does_not_depend_on_the_order_of_views():
    ours = cameras.pinhole(cameras.symmetric_intrinsics(20, 20, 0.9), cameras.fibonacci_sphere(8, 2.7), 20, 20)
    masks = pictures(box(0.4), ours, 20)
    order = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    turned = carve(masks[order], cameras.select(ours, order), Sphere(), 16)
    assert torch.equal(turned.occupied, carve(masks, ours, Sphere(), 16).occupied)


@pytest.mark.parametrize("compiled", [True, False])
def test_views_can_be_carved_one_by_one(compiled, monkeypatch):
    ours = cameras.pinhole(cameras.symmetric_intrinsics(20, 20, 0.9), cameras.fibonacci_sphere(8, 2.7), 20, 20)
    masks = pictures(box(0.4), ours, 20)
    if not compiled:
        monkeypatch.setattr("hyperplanes.geometry.occupancy.find_spec", lambda name: None)
    first = carve(masks[:3], cameras.select(ours, [0, 1, 2]), Sphere(), 18)
    before = first.occupied.clone()
    both = carve(masks[3:], cameras.select(ours, [3, 4, 5, 6, 7]), Sphere(), 18, within=first)
    assert torch.equal(both.occupied, carve(masks, ours, Sphere(), 18).occupied)
    assert both.occupied.sum() < before.sum()
    assert torch.equal(first.occupied, before)


def test_without_views_all_is_kept_and_empty_masks_keep_what_no_camera_sees():
    ours = cameras.pinhole(cameras.symmetric_intrinsics(20, 20, 0.3), cameras.orbit(2, 2.7), 20, 20)
    assert carve(torch.zeros(0, 1, 20, 20), cameras.select(ours, []), Sphere(), 8).occupied.all()
    hull = carve(torch.zeros(2, 1, 20, 20), ours, Sphere(), 8)
    assert 0 < hull.occupied.float().mean() < 1
    assert not hull.contains(torch.zeros(1, 3)).any()


def test_contains_and_centres_agree():
    """Closed form: a grid of side 2 over [-1, 1]^3 where only the voxel with x > 0, y > 0, z < 0 is set."""
    occupied = torch.zeros(2, 2, 2, dtype=torch.bool)
    occupied[1, 1, 0] = True
    grid = Occupancy(occupied, Sphere((1.0, 0.0, 0.0), 2.0))
    assert grid.voxel == 2.0
    assert grid.centres().tolist() == [[2.0, 1.0, -1.0]]
    points = torch.tensor([[2.0, 1.0, -1.0], [2.0, 1.0, 1.0], [9.0, 1.0, -1.0], [1.1, 0.1, -0.1]])
    assert grid.contains(points).tolist() == [True, False, False, True]
    assert grid.dilated().occupied.all()
    np.testing.assert_array_equal(grid.dilated(0).occupied.numpy(), occupied.numpy())


def test_the_surface_has_a_face_at_an_empty_voxel_or_at_the_border():
    grid = torch.rand(7, 7, 7, generator=torch.Generator().manual_seed(0)) < 0.9
    found = Occupancy(grid, Sphere()).surface().occupied
    for x, y, z in itertools.product(range(7), repeat=3):
        around = [(x + 1, y, z), (x - 1, y, z), (x, y + 1, z), (x, y - 1, z), (x, y, z + 1), (x, y, z - 1)]
        bare = any(min(each) < 0 or max(each) > 6 or not grid[each] for each in around)
        assert bool(found[x, y, z]) == (bool(grid[x, y, z]) and bare)


@pytest.mark.parametrize("side", [4, 5])
def test_an_odd_grid_gets_one_more_voxel_and_the_others_keep_their_positions(side):
    bounds = Sphere((0.5, -1.0, 0.0), 2.0)
    grid = Occupancy(torch.rand(side, side, side, generator=torch.Generator().manual_seed(0)) < 0.4, bounds)
    even = grid.with_even_side()
    assert len(even.occupied) == 2 * math.ceil(side / 2)
    torch.testing.assert_close(even.centres(), grid.centres())


def test_values_computed_from_voxels_follow_changes_of_the_voxels():
    grid = Occupancy(torch.zeros(32, 32, 32, dtype=torch.bool), Sphere())
    for reach in (4, 12):
        grid.occupied[16 - reach : 16 + reach, 10:20, 10:20] = True
        fresh = Occupancy(grid.occupied.clone(), grid.bounds)
        assert grid.box == fresh.box
        assert torch.equal(grid.surface_centres, fresh.surface_centres)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "voxels", [torch.ones(4, 4, 4), torch.ones(4, 2, 2).bool(), torch.ones(0, 0, 0).bool(), torch.ones(4, 4).bool()]
)
def test_a_grid_is_a_cube_of_booleans(voxels):
    """The kernels assume that."""
    with pytest.raises(ValueError, match=r"occupied: expected booleans \(side, side, side\), got"):
        Occupancy(voxels, Sphere())
