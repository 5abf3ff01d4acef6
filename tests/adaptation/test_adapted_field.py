"""Sources of truth: one pixel computed by the loops of tests/reference.py, a solid ball in closed form, and properties
(similarity transforms of the scene, permuted views, each view alone).
"""

from dataclasses import replace

import pytest
import torch

from hyperplanes.adaptation import AdaptedField
from hyperplanes.adaptation.base import hull
from hyperplanes.geometry.cameras import concatenate, look_at, pinhole, to
from hyperplanes.geometry.occupancy import MIN_MASK_OPACITY, Occupancy, full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering import Hierarchical, RayMarching, composite
from hyperplanes.views import Views
from tests.reference_rendering import awaken, ball_views, camera_at, composite_ray, ring, small_model

SOLID = Sphere(radius=0.5)


def solid_ball(points, directions):
    """A ball of radius 0.5 with a hard surface, whose colour depends on position and direction."""
    colour = (0.5 + 0.4 * torch.sin(3 * points) + 0.1 * directions).clamp(0, 1)
    return colour, 30.0 * (points.norm(dim=-1) < 0.5)


def adapted(sampling=None, bounds=None, side=16):
    return AdaptedField(solid_ball, full(bounds or Sphere(), side), sampling or RayMarching(60))


@pytest.mark.parametrize("sampling", [RayMarching(60, 1e-6), Hierarchical(48, 0), Hierarchical(24, 24)])
@pytest.mark.parametrize("size", [(9, 14), (14, 9)])
@torch.no_grad()
def test_pictures_agree_with_traced_rays(sampling, size):
    cameras, field = ring(2, size), adapted(sampling)
    pictures = field.render(cameras, sampling, antialias=False)
    assert pictures.images.shape == (2, 3, *size)
    assert pictures.opacity.shape == pictures.depth.shape == (2, 1, *size)
    posed = Views(pictures.images, cameras)
    for view in range(2):
        seen = field.trace(posed.rays(view, near_far=sampling.near_far))
        torch.testing.assert_close(pictures.images[view].flatten(1).T, seen.colour, atol=1e-4, rtol=0)
        torch.testing.assert_close(pictures.opacity[view].flatten(), seen.opacity, atol=1e-4, rtol=0)
        torch.testing.assert_close(pictures.depth[view].flatten(), seen.depth, atol=1e-3, rtol=0)


@torch.no_grad()
def test_the_number_of_steps_of_pictures_grows_with_the_root_of_the_pixels():
    sampling = RayMarching(48, 0.0)
    assert [sampling.for_rendering(pixels).steps for pixels in (12, 100, 400)] == [40, 80, 160]
    cameras, field = ring(2, (12, 12)), adapted(sampling)
    assert torch.equal(field.render(cameras).images, field.render(cameras, RayMarching(40, 0.0)).images)


@torch.no_grad()
def test_one_pixel_against_the_loop():
    cameras = camera_at((0.0, 0.0, 3.0), (5, 5))
    pictures = adapted(Hierarchical(40, 0)).render(cameras)
    # the ray of the middle pixel goes along -z from distance 2 to 4: 40 intervals of 0.05
    edges = [2 + 0.05 * index for index in range(41)]
    points = torch.tensor([[0.0, 0.0, 3 - (a + b) / 2] for a, b in zip(edges, edges[1:], strict=False)])
    colour, density = solid_ball(points, torch.tensor([[0.0, 0.0, -1.0]]).expand(40, 3))
    expected = composite_ray(colour.tolist(), density.tolist(), edges)
    assert pictures.images[0, :, 2, 2].tolist() == pytest.approx(expected[0], abs=1e-4)
    assert pictures.depth[0, 0, 2, 2].item() == pytest.approx(expected[2], abs=1e-4)
    composed, _ = composite(colour[None], density[None], torch.tensor([edges]))
    assert pictures.images[0, :, 2, 2].tolist() == pytest.approx(composed.colour[0].tolist(), abs=1e-4)


@torch.no_grad()
def test_pictures_of_a_solid_ball_agree_with_its_geometry():
    # closed form: opaque where the ray hits the ball, with the depth of the hit
    cameras = ring(2, (20, 20))
    pictures, truth = adapted(RayMarching(150)).render(cameras), ball_views(cameras)
    inner = -torch.nn.functional.max_pool2d(-truth.masks, 3, 1, 1) > 0
    outer = torch.nn.functional.max_pool2d(truth.masks, 3, 1, 1) == 0
    assert inner.any()
    assert (pictures.opacity[inner] > 0.99).all()
    assert (pictures.opacity[outer] == 0).all()
    assert (pictures.images.permute(0, 2, 3, 1)[outer[:, 0]] == 1).all()
    for view in range(2):
        near = Views(truth.images, cameras, bounds=SOLID).rays(view).near.reshape(20, 20)
        # E[t] lies 1 / sigma = 0.033 behind the surface
        error = (pictures.depth[view, 0] - near - 1 / 30)[inner[view, 0]]
        assert error.abs().max() < 0.02


@pytest.mark.parametrize("sampling", [RayMarching(60), Hierarchical(48, 16)])
@torch.no_grad()
def test_a_scene_moved_and_scaled_with_its_cameras_gives_the_same_picture(sampling):
    shift, scale = torch.tensor([2.0, -1.0, 0.5]), 3.0

    def moved_ball(points, directions):
        colour, density = solid_ball((points - shift) / scale, directions)
        return colour, density / scale

    eye = torch.tensor([0.6, 1.0, 2.8])
    here = adapted(sampling).render(camera_at(tuple(eye.tolist()), (12, 17)))
    camera = camera_at(tuple((eye * scale + shift).tolist()), (12, 17), target=tuple(shift.tolist()))
    bounds = Sphere(tuple(shift.tolist()), scale)
    there = AdaptedField(moved_ball, full(bounds, 16), sampling).render(camera)
    # a hard surface: rays that graze it may fall on either side by rounding
    close = (there.images - here.images).abs().amax(1) < 1e-3
    assert close.float().mean() > 0.97
    depth = (there.depth / scale - here.depth).abs()[:, 0]
    assert (depth < 1e-3).float().mean() > 0.97


@torch.no_grad()
def test_views_are_rendered_independently():
    one, other = camera_at((0.0, 0.5, 3.0)), camera_at((2.0, 1.0, 2.0))
    field = adapted()
    both = field.render(concatenate([one, other]))
    torch.testing.assert_close(both.images[:1], field.render(one).images)
    torch.testing.assert_close(both.images[1:], field.render(other).images)
    assert both.samples == field.render(one).samples + field.render(other).samples


@torch.no_grad()
def test_a_camera_inside_the_bounds_sees_what_is_ahead():
    ahead = adapted().render(camera_at((0.0, 0.0, 0.8), (9, 9)))
    assert ahead.opacity[0, 0, 4, 4] > 0.99
    assert ahead.depth[0, 0, 4, 4].item() == pytest.approx(0.3 + 1 / 30, abs=0.05)
    away = adapted().render(camera_at((0.0, 0.0, 0.8), (9, 9), target=(0.0, 0.0, 2.0)))
    assert (away.opacity == 0).all()
    assert (away.images == 1).all()


@torch.no_grad()
def test_an_empty_hull_gives_a_white_picture():
    nothing = Occupancy(torch.zeros(8, 8, 8, dtype=torch.bool), Sphere())
    pictures = AdaptedField(solid_ball, nothing, RayMarching()).render(ring(2))
    assert (pictures.images == 1).all()
    assert pictures.samples == 0


@torch.no_grad()
def test_another_protocol_can_be_chosen():
    field = adapted(RayMarching(60))
    pictures = field.render(ring(1, (8, 8)), sampling=Hierarchical(10, 6))
    assert pictures.samples == 64 * (10 + 10 + 6)
    marched = field.render(ring(1, (8, 8)))
    assert 0 < marched.samples < pictures.samples


def test_pictures_carry_no_gradients_but_traces_do():
    level = torch.tensor(0.5, requires_grad=True)

    def field(points, directions):
        return level.expand(len(points), 3), solid_ball(points, directions)[1]

    whole = AdaptedField(field, full(Sphere(), 8), RayMarching(40))
    pictures = whole.render(ring(1))
    assert not pictures.images.requires_grad
    whole.trace(Views(pictures.images, ring(1)).rays(0)).colour.sum().backward()
    assert level.grad > 0


@torch.no_grad()
def test_calling_an_adapted_field_calls_its_field():
    points, directions = torch.rand(7, 3), torch.rand(7, 3)
    for mine, own in zip(adapted()(points, directions), solid_ball(points, directions), strict=True):
        assert torch.equal(mine, own)


def ball_surface(radius):
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    return radius * points / points.norm(dim=1, keepdim=True)


def test_the_hull_contains_the_object_and_is_full_without_masks():
    views = ball_views(ring(6, (32, 32)), bounds=Sphere((0.1, 0.0, 0.0), 1.2))
    carved = hull(views, 24)
    assert carved.contains(ball_surface(0.49)).all()
    assert carved.occupied.float().mean() < 0.3
    assert carved.bounds == views.bounds
    plain = hull(Views(views.images, views.cameras, bounds=views.bounds), 24)
    assert plain.occupied.all()
    assert plain.occupied.shape == (24, 24, 24)


@pytest.mark.parametrize("focal", [(60.0, 240.0), (240.0, 60.0)])
def test_the_hull_is_not_cut_by_cameras_whose_pixels_are_not_square(focal):
    size = (int(focal[1]), int(focal[0]))
    matrix = torch.tensor([[focal[0], 0, size[1] / 2 - 0.5], [0, focal[1], size[0] / 2 - 0.5], [0, 0, 1.0]])
    eyes = torch.tensor([[0.0, 0.4, 3.0], [3.0, 0.2, 0.0], [0.0, 0.1, -3.0]])
    views = ball_views(pinhole(matrix, look_at(eyes), *size), radius=0.3)
    assert hull(views, 8).contains(ball_surface(0.29)).all()


def test_the_hull_does_not_depend_on_the_order_of_the_views():
    views = ball_views(ring(6, (20, 20)))
    assert torch.equal(hull(views, 16).occupied, hull(views[[3, 0, 5, 1, 4, 2]], 16).occupied)


@pytest.mark.parametrize("sampling", [RayMarching(60), Hierarchical(24, 24)])
@torch.no_grad()
def test_cameras_in_double_precision_see_the_same(sampling):
    cameras, field = ring(2, (12, 15)), adapted(sampling)
    single, double = field.render(cameras), field.render(to(cameras, dtype=torch.float64))
    assert double.images.dtype == torch.float32
    # a hard surface: rays that graze it may fall on either side by rounding
    assert ((single.images - double.images).abs().amax(1) < 1e-3).float().mean() > 0.97


def test_masks_with_an_empty_hull_are_refused():
    views = replace(ball_views(ring(3)), names=("front", "side", "back"))
    blank = replace(views, masks=torch.zeros_like(views.masks))
    with pytest.raises(ValueError, match=r"masks of the support views \(front to back\): expected an object, got none"):
        hull(blank, 8)
    # each mask has a pixel set, but no voxel within the bounds projects to all of them
    apart = torch.zeros_like(views.masks)
    apart[0, 0, 0, 0] = apart[1, 0, -1, -1] = apart[2, 0, 0, -1] = 1.0
    with pytest.raises(ValueError, match="got no point that all of them may show; check"):
        hull(replace(views, masks=apart, bounds=Sphere(radius=0.3)), 32)


def test_an_empty_mask_is_refused_by_name_or_number():
    """It says that nothing of the object is in its picture, and would remove what all other masks show."""
    views = ball_views(ring(5))
    views.masks[3] = 0.0
    message = (
        "masks of the support views: expected a part of the object in each, found 1 of 5 empty: 3; "
        "leave these views out or correct their masks"
    )
    for refused in (lambda given: hull(given, 16), small_model().find_symmetry, small_model().adapt):
        with pytest.raises(ValueError, match=f"^{message}$"):
            refused(views)
    views.masks[1] = 0.0
    with pytest.raises(ValueError, match="found 2 of 5 empty: r_1, r_3; leave"):
        hull(replace(views, names=tuple(f"r_{index}" for index in range(5))), 16)
    assert hull(views[[0, 2, 4]], 16).occupied.any()


def test_masks_whose_background_is_hardly_opaque_are_refused():
    """An opacity of 1 / 255 in the whole background would make the hull all that the cameras see."""
    views = ball_views(ring(5))
    hazy = replace(views, masks=views.masks.clamp_min(1 / 255))
    with pytest.raises(
        ValueError, match=r"expected opacity 0 in the background, found 0.0039 in most pixels of 5 of 5"
    ):
        hull(hazy, 16)
    cleared = replace(hazy, masks=torch.where(hazy.masks < MIN_MASK_OPACITY, 0.0, hazy.masks))
    assert torch.equal(hull(cleared, 16).occupied, hull(views, 16).occupied)


@pytest.mark.parametrize("sampling", [RayMarching(60), Hierarchical(24, 24)])
def test_rays_without_gradients_show_the_same(sampling):
    field = adapted(sampling)
    rays, _ = ball_views(ring(2)).sample_rays(300, generator=torch.Generator().manual_seed(0))
    whole, ended = field.trace(rays), field.trace(rays, differentiable=False)
    assert ended.samples <= whole.samples
    assert (ended.samples < whole.samples) == (sampling.stop > 0)
    torch.testing.assert_close(ended.colour, whole.colour, atol=max(1e-6, sampling.stop), rtol=0)


@torch.no_grad()
def test_pictures_change_with_in_place_changes_of_weights_and_voxels():
    views = ball_views(ring(4))
    field, cameras = awaken(small_model()).eval().adapt(views), ring(1, shift=1)
    before, bias = field.render(cameras).opacity, field.field.parameters["density.bias"]
    trained = bias.clone()
    bias -= 50
    assert field.render(cameras).opacity.max() < 1e-3
    bias.copy_(trained)
    assert torch.equal(field.render(cameras).opacity, before)
    assert before.max() > 0.01
    field.occupancy.occupied.zero_()
    assert field.render(cameras).opacity.max() == 0


@pytest.mark.usefixtures("unchecked")
@torch.no_grad()
def test_rays_of_any_precision_are_traced_and_points_of_another_shape_are_refused():
    views = ball_views(ring(4))
    field = awaken(small_model()).eval().adapt(views)
    expected = field.trace(views.rays(0), differentiable=False).colour
    found = field.trace(views.to(dtype=torch.float64).rays(0), differentiable=False).colour
    assert found.dtype == expected.dtype
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
    with pytest.raises(ValueError, match=r"points: .*write points\[None\] for a single point"):
        field.density(torch.zeros(3))
