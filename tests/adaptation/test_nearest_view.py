"""Source of truth: the support images themselves, copied; angles between camera directions by hand."""

import math

import pytest
import torch

from hyperplanes.adaptation import NearestView
from hyperplanes.geometry.cameras import concatenate, pinhole, resized, select
from hyperplanes.geometry.distortion import distorted
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views
from tests.reference_rendering import ball_views, camera_at, ring


def support(count=5, size=(12, 16), bounds=None):
    images = torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(0))
    return Views(images, ring(count, size), bounds=bounds or Sphere())


def test_the_picture_of_a_support_camera_is_its_image():
    views, order = support(), torch.tensor([3, 0, 4, 1, 2])
    pictures = NearestView().adapt(views).render(select(views.cameras, order))
    assert torch.equal(pictures.images, views.images[order])
    assert pictures.samples == 0


def test_the_nearest_direction_counts_from_the_centre_of_the_scene():
    # cameras at x = 2 and z = 4 about the centre (0, 0, 1): directions (2, 0, -1) and (0, 0, 3)
    cameras = concatenate([camera_at((2.0, 0.0, 0.0)), camera_at((0.0, 0.0, 4.0))])
    images = torch.stack([torch.zeros(3, 16, 16), torch.ones(3, 16, 16)])
    views = Views(images, cameras, bounds=Sphere((0.0, 0.0, 1.0), 1.0))
    # from (2, 0, 2.2), direction (2, 0, 1.2): nearer to the first
    # cos to (2, 0, -1): (4 - 1.2) / (2.332 * 2.236) = 0.537; cos to (0, 0, 3): 1.2 / 2.332 = 0.515
    asked = concatenate([camera_at((2.0, 0.0, 2.2)), camera_at((2.0, 0.0, 2.5))])
    # from (2, 0, 2.5), direction (2, 0, 1.5): cos 2.5 / (2.5 * 2.236) = 0.447 against 1.5 / 2.5 = 0.6
    pictures = NearestView().adapt(views).render(asked)
    assert pictures.images.flatten(1).mean(1).tolist() == [0.0, 1.0]


def test_autocast_does_not_change_which_view_is_the_nearest():
    # at 0, 0.02 and 0.015 radians: cosines of 0.99989 and 0.99999, which in bfloat16 are both 1
    first, second, asked = (camera_at((3 * math.sin(angle), 0.0, 3 * math.cos(angle))) for angle in (0.0, 0.02, 0.015))
    images = torch.stack([torch.zeros(3, 16, 16), torch.ones(3, 16, 16)])
    copies = NearestView().adapt(Views(images, concatenate([first, second])))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(copies.render(asked).images, images[1:])


def test_the_distance_of_the_camera_does_not_matter():
    near = camera_at((0.0, 0.3, 9.0), (12, 16))
    views = support()
    picture = NearestView().adapt(views).render(near).images
    unit = torch.tensor([0.0, 0.3, 9.0]) / torch.tensor([0.0, 0.3, 9.0]).norm()
    centres = torch.linalg.inv(views.cameras.extrinsics)[:, :3, 3]
    expected = (centres / centres.norm(dim=1, keepdim=True) @ unit).argmax()
    assert torch.equal(picture[0], views.images[expected])


def seen(views, focal, middle, size):
    """The picture of the first camera with other intrinsics."""
    matrix = torch.tensor([[focal[0], 0, middle[0]], [0, focal[1], middle[1]], [0, 0, 1.0]])
    asked = pinhole(matrix, views.cameras.extrinsics[:1], *size)
    return NearestView().adapt(views).render(asked)


def test_an_image_of_another_aspect_ratio_is_padded_and_not_stretched():
    # the same focal length; the image is 4 columns wider and 3 rows lower, and its first row is cut off
    views = support()
    (fx, fy), (cx, cy) = views.cameras.intrinsics[0, [0, 1], [0, 1]], views.cameras.intrinsics[0, :2, 2]
    found = seen(views, (fx, fy), (cx + 2, cy - 1), (9, 20))
    torch.testing.assert_close(found.images[0, :, :, 2:18], views.images[0, :, 1:10], atol=1e-4, rtol=0)
    for edge in (slice(0, 2), slice(18, 20)):
        assert (found.images[0, :, :, edge] == 1).all()
        assert (found.opacity[0, :, :, edge] == 0).all()
    assert (found.opacity[0, :, :, 2:18] == 1).all()


def test_a_longer_focal_length_magnifies_the_middle_by_bilinear_interpolation():
    # column u of the new camera is column (u - 4) / 2 + 7.5 of the copied image, and rows likewise
    views = support()
    fx, fy = views.cameras.intrinsics[0, [0, 1], [0, 1]]
    found = seen(views, (2 * fx, 2 * fy), (4.0, 4.0), (9, 9)).images[0]
    pixels = views.images[0]
    between = (pixels[:, 5, 7] + pixels[:, 5, 8] + pixels[:, 6, 7] + pixels[:, 6, 8]) / 4
    torch.testing.assert_close(found[:, 4, 4], between, atol=1e-4, rtol=0)  # (7.5, 5.5)
    torch.testing.assert_close(found[:, 3, 5], pixels[:, 5, 8], atol=1e-4, rtol=0)


def test_smaller_pictures_are_averaged():
    # alternating black and white columns become grey away from the borders, and the opacity is 1
    views = Views(torch.arange(2).repeat(8).expand(1, 3, 16, 16).float(), ring(1, (16, 16)))
    small = NearestView().adapt(views).render(resized(views.cameras, 4, 4))
    torch.testing.assert_close(small.images[..., 1:3], torch.full((1, 3, 4, 2), 0.5), atol=0.02, rtol=0)
    torch.testing.assert_close(small.opacity, torch.ones(1, 1, 4, 4))


def test_lens_distortion_agrees_with_opencv():
    views = support()
    (fx, fy), (cx, cy) = views.cameras.intrinsics[0, [0, 1], [0, 1]], views.cameras.intrinsics[0, :2, 2]
    bent = distorted(select(views.cameras, [0]), torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0]))
    one = Views(views.images[:1], bent)
    assert torch.equal(NearestView().adapt(one).render(bent).images, one.images)
    found = seen(one, (fx, fy), (cx, cy), (12, 16)).images[0]
    # pixel (7, 3) of the undistorted camera: (-0.5 / fx, -2.5 / fy) times 1 + k1 r^2 in the copied image
    x, y = -0.5 / fx, -2.5 / fy
    factor = 1 + 0.1 * (x * x + y * y)
    u, v = factor * x * fx + cx, factor * y * fy + cy
    left, top = int(u), int(v)
    a, b = u - left, v - top
    square = one.images[0, :, top : top + 2, left : left + 2]
    expected = (1 - b) * ((1 - a) * square[:, 0, 0] + a * square[:, 0, 1])
    expected = expected + b * ((1 - a) * square[:, 1, 0] + a * square[:, 1, 1])
    torch.testing.assert_close(found[:, 3, 7], expected, atol=1e-4, rtol=0)


def test_the_opacity_is_the_mask_of_the_copied_view_or_1_without_masks():
    plain = support()
    masked = Views(plain.images, plain.cameras, (plain.images[:, :1] > 0.5).float())
    order = torch.tensor([2, 0])
    pictures = NearestView().adapt(masked).render(select(masked.cameras, order))
    assert torch.equal(pictures.opacity, masked.masks[order])
    assert torch.equal(pictures.images, plain.images[order])
    assert (NearestView().adapt(plain).render(select(plain.cameras, order)).opacity == 1).all()


def test_no_views_are_refused():
    with pytest.raises(ValueError, match="support: expected at least one view, got none"):
        NearestView().adapt(ball_views(ring(2))[:0])


def test_no_cameras_have_no_pictures():
    views = support()
    pictures = NearestView().adapt(views).render(select(views.cameras, slice(0, 0)))
    assert len(pictures.images) == len(pictures.opacity) == len(pictures.depth) == 0
    assert pictures.images.shape[1:] == (3, *views.size)
