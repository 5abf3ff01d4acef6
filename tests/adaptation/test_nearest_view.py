"""Source of truth: the support images themselves, copied; angles between camera directions by hand."""

import pytest
import torch

from hyperplanes.adaptation import NearestView
from hyperplanes.geometry.cameras import concatenate, select
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views
from tests.reference_rendering import ball_views, camera_at, ring


def support(count=5, size=(12, 16), bounds=None):
    images = torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(0))
    return Views(images, ring(count, size), bounds=bounds or Sphere())


def test_seen_from_a_support_camera_it_is_that_image():
    views, order = support(), torch.tensor([3, 0, 4, 1, 2])
    pictures = NearestView().adapt(views).render(select(views.cameras, order))
    assert torch.equal(pictures.images, views.images[order])
    assert pictures.samples == 0


def test_the_nearest_direction_counts_from_the_centre_of_the_scene():
    # cameras at x = 2 and z = 4 about the centre (0, 0, 1): directions (2, 0, -1) and (0, 0, 3)
    cameras = concatenate([camera_at((2.0, 0.0, 0.0)), camera_at((0.0, 0.0, 4.0))])
    images = torch.stack([torch.zeros(3, 16, 16), torch.ones(3, 16, 16)])
    views = Views(images, cameras, bounds=Sphere((0.0, 0.0, 1.0), 1.0))
    # from (2, 0, 2.2), direction (2, 0, 1.2): nearer to the second (0.51 against 0.54 with the first)?
    # cos to (2, 0, -1): (4 - 1.2) / (2.332 * 2.236) = 0.537; cos to (0, 0, 3): 1.2 / 2.332 = 0.515
    asked = concatenate([camera_at((2.0, 0.0, 2.2)), camera_at((2.0, 0.0, 2.5))])
    # from (2, 0, 2.5), direction (2, 0, 1.5): cos 2.5 / (2.5 * 2.236) = 0.447 against 1.5 / 2.5 = 0.6
    pictures = NearestView().adapt(views).render(asked)
    assert pictures.images.flatten(1).mean(1).tolist() == [0.0, 1.0]


def test_a_distance_does_not_matter():
    near = camera_at((0.0, 0.3, 9.0), (12, 16))
    views = support()
    picture = NearestView().adapt(views).render(near).images
    unit = torch.tensor([0.0, 0.3, 9.0]) / torch.tensor([0.0, 0.3, 9.0]).norm()
    centres = torch.linalg.inv(views.cameras.extrinsics)[:, :3, 3]
    expected = (centres / centres.norm(dim=1, keepdim=True) @ unit).argmax()
    assert torch.equal(picture[0], views.images[expected])


def test_images_of_another_size_are_scaled():
    views = Views(torch.full((2, 3, 12, 16), 0.25), ring(2, (12, 16)))
    pictures = NearestView().adapt(views).render(ring(1, (24, 20)))
    assert pictures.images.shape == (1, 3, 24, 20)
    torch.testing.assert_close(pictures.images, torch.full((1, 3, 24, 20), 0.25))


def test_the_opacity_is_the_mask_of_the_copied_view_and_one_without_masks():
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
