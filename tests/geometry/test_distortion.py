"""Source of truth: OpenCV's projectPoints."""

import numpy as np
import pytest
import torch

from hyperplanes.data.inspection.conventions import check_conventions
from hyperplanes.data.pictures.bounds import estimate_bounds
from hyperplanes.data.pictures.undistort import distort
from hyperplanes.data.upright import upright, y_up_from
from hyperplanes.export.images import orbit_cameras
from hyperplanes.geometry import ImagePlanes, Sphere, cameras, carve, cast, distortion
from hyperplanes.geometry.distortion import (
    DistortedCamera,
    distorted,
    distorted_pixels,
    turning_radius,
    undistorted_pixels,
)
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import pixel_grid
from hyperplanes.rendering import RayMarching, render
from hyperplanes.views import Views
from tests.reference_rendering import ring
from tests.test_conventions import HEIGHT, WIDTH, K, opencv_pixels, poses, some_points

LENS = torch.tensor([-0.28, 0.07, 0.002, -0.001, -0.01], dtype=torch.float64)


def lenses():
    return distorted(cameras.pinhole(K, poses(), HEIGHT, WIDTH), LENS)


@pytest.mark.parametrize("chosen", [False, True])
def test_lookups_apply_the_lens_as_opencv_does(chosen):
    images = torch.zeros(6, 1, HEIGHT, WIDTH, dtype=torch.float64)
    views = torch.arange(6).flip(0).expand(200, 6) if chosen else None
    found = ImagePlanes(images, lenses()).lookup(some_points(), views)
    pixels = ((found.coordinates + 1) / 2 * torch.tensor([WIDTH - 1, HEIGHT - 1])).transpose(0, 1).numpy()
    expected = opencv_pixels(some_points(), K, poses(), LENS)
    expected = expected[::-1] if chosen else expected
    inside = found.valid.T.numpy()
    assert inside.mean() > 0.8
    np.testing.assert_allclose(pixels[inside], np.clip(expected, 0, [WIDTH - 1, HEIGHT - 1])[inside], atol=1e-9)


def test_rays_undo_the_lens_as_opencv_does():
    """OpenCV's `projectPoints` projects each ray to its pixel; the arguments of its inverse depend on the release."""
    pixels = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pixels = pixels * torch.tensor([WIDTH - 1, HEIGHT - 1])
    rays = cast(lenses(), torch.full((50,), 2), pixels)
    points = rays.origins + 3 * rays.directions
    again = opencv_pixels(points, K, poses(), LENS)[2]
    np.testing.assert_allclose(again, pixels.numpy(), atol=1e-6)


def test_rays_through_strong_lenses_are_projected_to_their_pixels():
    """Property: `distorted_pixels` after the inverse is the identity wherever the inverse is valid."""
    matrix = torch.tensor([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    bare = cameras.pinhole(matrix, torch.eye(4, dtype=torch.float64)[None], 48, 64)
    pixels = pixel_grid(48, 64).double()
    view = torch.zeros(len(pixels), dtype=torch.long)
    for lens, everywhere in (
        ([-0.9, 0.5, 0.0, 0.0, 0.0], True),
        ([0.1, 0.3, 0.01, -0.02, 0.0], True),
        ([-1.2, 0.0, 0.0, 0.0, 0.0], False),
        ([0.0, -3690.0, 0.0, 0.0, 0.0], False),
    ):
        ours = distorted(bare, torch.tensor(lens, dtype=torch.float64))
        ideal, found = undistorted_pixels(ours, view, pixels)
        again, shown = distorted_pixels(ours, ideal[:, None])
        assert bool(found.all()) == everywhere
        assert shown[found].all()
        assert (again[:, 0] - pixels)[found].abs().max() < 1e-9
        assert ideal.isfinite().all()


def test_pixels_beyond_the_fold_have_no_ray():
    """Closed form: r - r^3 / 3 has its maximum, 2 / 3, at r = 1. Pixels farther from the centre have no ray."""
    matrix = torch.tensor([[10.0, 0.0, 20.0], [0.0, 10.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    bare = cameras.pinhole(matrix, torch.eye(4, dtype=torch.float64)[None], 41, 41)
    ours = distorted(bare, torch.tensor([-1 / 3, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    pixels = torch.tensor([[20.0, 20.0], [26.6, 20.0], [26.7, 20.0], [0.0, 0.0]], dtype=torch.float64)
    rays = cast(ours, torch.zeros(4, dtype=torch.long), pixels, Sphere((0.0, 0.0, 1.0), 0.9))
    assert (rays.far > rays.near).tolist()[2:] == [False, False]
    assert rays.directions[3] @ torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) < 0  # not on the opposite side
    constant = cast(ours, torch.zeros(4, dtype=torch.long), pixels, near_far="constant")
    assert (constant.far > constant.near).tolist() == [True, True, False, False]
    points = ours.unproject(pixels[None], torch.ones(1, 4, 1, dtype=torch.float64))[0]
    assert points.isnan().any(1).tolist() == [False, False, True, True]
    x = float(points[1, 0])
    assert x - x**3 / 3 == pytest.approx(0.66)


def test_the_inverse_has_the_gradient_of_finite_differences():
    lens = LENS.clone().requires_grad_(True)
    pixels = torch.tensor([[3.0, 4.0], [60.0, 20.0]], dtype=torch.float64, requires_grad=True)
    bare = cameras.select(cameras.pinhole(K, poses(), HEIGHT, WIDTH), [0])
    view = torch.zeros(2, dtype=torch.long)

    def inverse(lens, pixels):
        return undistorted_pixels(DistortedCamera(bare, lens[None]), view, pixels)[0]

    assert torch.autograd.gradcheck(inverse, (lens, pixels))


def test_the_fold_of_the_rational_model():
    """Brute force: the first radius on a fine grid at which the distorted radius stops growing."""
    lens = (0.3, -0.5, 0.0, 0.0, 0.02, 0.8, 0.1, 0.05)
    radius = torch.linspace(0, 4, 400_001, dtype=torch.float64)
    across = distort(torch.stack([radius, 0 * radius], 1).numpy(), lens)[:, 0]
    turn = float(radius[int(np.argmax(np.diff(across) <= 0))])
    assert float(turning_radius(torch.tensor([lens], dtype=torch.float64))) == pytest.approx(turn, abs=2e-5)


def test_cameras_made_from_others_keep_their_lenses():
    """Orbits and perturbed poses keep the lens of the views; carving refuses cameras with a lens."""
    views = Views(torch.zeros(6, 3, HEIGHT, WIDTH, dtype=torch.float64), lenses())
    orbit = orbit_cameras(views, 3, size=32)
    assert isinstance(orbit, DistortedCamera)
    torch.testing.assert_close(orbit.distortion, LENS.expand(3, 5))
    alpha = torch.full((6, 1, HEIGHT, WIDTH), 255, dtype=torch.uint8)
    assert estimate_bounds(lenses(), alpha) == estimate_bounds(lenses())
    masked = Views(views.images, lenses(), torch.zeros(6, 1, HEIGHT, WIDTH, dtype=torch.float64))
    masked.masks[:, :, 10:20, 10:20] = 1.0
    with pytest.raises(ValueError, match="undistort the masks first"):
        check_conventions(masked)
    small = cameras.cropped(lenses(), 7, 9)
    assert isinstance(small, DistortedCamera)
    assert cameras.image_size(small) == (7, 9)


def test_points_beyond_the_fold_are_not_valid():
    """Closed form: with only k1 = -1/3, r - r^3 / 3 decreases beyond r = 1, so that points move back to the centre."""
    matrix = torch.tensor([[10.0, 0.0, 20.0], [0.0, 10.0, 20.0], [0.0, 0.0, 1.0]])
    bare = cameras.pinhole(matrix, torch.eye(4)[None], 41, 41)
    planes = ImagePlanes(torch.zeros(1, 1, 41, 41), distorted(bare, torch.tensor([-1 / 3, 0.0, 0.0, 0.0, 0.0])))
    points = torch.tensor([[0.9, 0.0, 1.0], [1.1, 0.0, 1.0], [3**0.5, 0.0, 1.0]])
    assert planes.lookup(points).valid[:, 0].tolist() == [True, False, False]


def test_lenses_are_kept():
    ours = cameras.to(cameras.resized(cameras.select(lenses(), [3, 1]), 96, 160), dtype=torch.float32)
    assert isinstance(ours, DistortedCamera)
    torch.testing.assert_close(ours.distortion, LENS.float().expand(2, 5))
    both = cameras.concatenate([lenses(), cameras.pinhole(K, poses(), HEIGHT, WIDTH)])
    assert isinstance(both, DistortedCamera)
    assert both.distortion[6:].abs().max() == 0


def test_the_turning_radius_is_computed_once_until_the_lens_changes(monkeypatch):
    made = []
    monkeypatch.setattr(distortion, "turning_radius", lambda given: made.append(given) or turning_radius(given))
    pinholes, points = cameras.pinhole(K, poses(), HEIGHT, WIDTH), some_points()
    planes = ImagePlanes(torch.zeros(6, 1, HEIGHT, WIDTH, dtype=torch.float64), distorted(pinholes, LENS.repeat(6, 1)))
    first = planes.lookup(points).coordinates
    planes.lookup(points)
    cast(planes.cameras, torch.tensor([0]), torch.zeros(1, 2, dtype=torch.float64))
    assert len(made) == 1
    planes.cameras.distortion.copy_(torch.zeros(6, 5))
    assert not torch.equal(planes.lookup(points).coordinates, first)
    assert len(made) == 2


def test_no_distortion_changes_nothing():
    images = torch.rand(6, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    bare = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    plain = ImagePlanes(images, bare).lookup(some_points())
    behind_glass = ImagePlanes(images, distorted(bare, torch.zeros(5))).lookup(some_points())
    torch.testing.assert_close(behind_glass.colours, plain.colours)


def test_project_and_unproject_apply_the_lens_as_opencv_does():
    ours, points = lenses(), some_points()
    pixels = ours.project(points.expand(6, -1, 3))
    shown = pixels.isfinite().all(-1)
    assert shown.double().mean() > 0.8
    np.testing.assert_allclose(pixels[shown], opencv_pixels(points, K, poses(), LENS)[shown.numpy()], atol=1e-9)
    near = shown & (pixels > 0).all(-1) & (pixels < torch.tensor([WIDTH, HEIGHT])).all(-1)
    z = (poses()[:, 2, :3] @ points.T + poses()[:, 2, 3:])[..., None]
    again = ours.unproject(pixels.nan_to_num(), z)
    torch.testing.assert_close(again[near], points.expand(6, -1, 3)[near], atol=1e-4, rtol=0)


def test_points_that_the_lens_cannot_show_are_not_projected():
    matrix = torch.tensor([[10.0, 0.0, 20.0], [0.0, 10.0, 20.0], [0.0, 0.0, 1.0]])
    bare = cameras.pinhole(matrix, torch.eye(4)[None], 41, 41)
    ours = distorted(bare, torch.tensor([-1 / 3, 0.0, 0.0, 0.0, 0.0]))
    pixels = ours.project(torch.tensor([[[0.9, 0.0, 1.0], [1.1, 0.0, 1.0]]]))[0]
    assert pixels[0].tolist() == pytest.approx([20 + 10 * (0.9 - 0.9**3 / 3), 20.0], abs=1e-5)
    assert pixels[1].isnan().all()


def test_operations_that_would_lose_the_lens_are_refused():
    with pytest.raises(ValueError, match=r"scale: .* got a DistortedCamera; use cameras.resized"):
        lenses().scale(torch.tensor([2.0]))
    with pytest.raises(ValueError, match=r"scale: .* use cameras.resized"):
        lenses().scale_(2.0)
    with pytest.raises(ValueError, match=r"point_3d: expected shape \(6, point, 3\), got \(9, 3\)"):
        lenses().project(torch.zeros(9, 3, dtype=torch.float64))
    assert torch.equal(lenses().clone().distortion, lenses().distortion)


def test_pictures_through_a_lens_miss_no_pixel():
    """Source of truth: every ray of the picture rendered alone. A strong barrel lens makes the ball's image smaller."""
    bare = ring(2, (24, 24))
    ours = distorted(bare, torch.tensor([-0.9, 0.5, 0.0, 0.0, 0.0]))
    grid = full(Sphere(), 8)

    def ball(points, directions):
        return points.abs(), 30.0 * (points.norm(dim=-1) < 0.9)

    picture = render(ball, ours, RayMarching(40), occupancy=grid, antialias=False)
    views = Views(picture.images, ours)
    for view in range(2):
        seen = render(ball, views.rays(view), RayMarching(40), occupancy=grid, differentiable=False)
        torch.testing.assert_close(picture.images[view].flatten(1).T, seen.colour)
    plain = render(ball, bare, RayMarching(40), occupancy=grid, antialias=False)
    assert (plain.opacity - picture.opacity).abs().max() > 0.9


def test_cameras_in_rotated_world_coordinates_keep_their_lenses():
    ours = lenses()
    views = Views(torch.zeros(6, 3, HEIGHT, WIDTH, dtype=torch.float64), ours)
    turned = upright(views, "z").cameras
    assert isinstance(turned, DistortedCamera)
    points = some_points()
    moved = points @ y_up_from("z")[:3, :3].T
    torch.testing.assert_close(
        turned.project(moved.expand(6, -1, 3)), ours.project(points.expand(6, -1, 3)), equal_nan=True
    )


def test_wrong_lenses_are_refused():
    bare = cameras.pinhole(K, poses(), HEIGHT, WIDTH)
    with pytest.raises(ValueError, match=r"expected shape \(5,\) or \(6, 5\), got \(2, 5\)"):
        distorted(bare, torch.zeros(2, 5))
    skewed = K.clone()
    skewed[0, 1] = 1.0
    with pytest.raises(ValueError, match="no skew"):
        distorted(cameras.pinhole(skewed, poses(), HEIGHT, WIDTH), LENS)
    with pytest.raises(ValueError, match="undistort the masks first"):
        carve(torch.ones(6, 1, HEIGHT, WIDTH, dtype=torch.float64), lenses(), Sphere(), 8)
