"""Source of truth: long animations of many views are rendered from voxels on a CPU, unless another choice is given."""

import pytest
import torch

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.animation import choose_representation
from hyperplanes.export.baking import BakedScene, default_side
from hyperplanes.export.images import orbit_cameras
from hyperplanes.fields.baked import BakedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.views import Views
from tests.reference_rendering import ball_views, ring

FIELD = AdaptedField(lambda points, directions: (points, points[:, 0]), full(Sphere(), 4), RayMarching(steps=8))
VOXELS = BakedField(torch.full((4, 4, 4), -1, dtype=torch.int32), torch.zeros(0, 28), Sphere())


@pytest.mark.parametrize(
    ("frames", "side", "shown", "representation", "by_voxels"),
    [
        (48, 400, 25, "auto", True),
        (8, 400, 25, "auto", False),  # few frames
        (48, 400, 15, "auto", False),  # few views
        (1, 8, 3, "voxels", True),
        (48, 400, 25, "field", False),
    ],
)
def test_long_animations_of_many_views_are_rendered_from_voxels(frames, side, shown, representation, by_voxels):
    lens = camera.symmetric_intrinsics(side, side, 0.8)
    cameras = camera.pinhole(lens, torch.eye(4).expand(frames, 4, 4), side, side)
    poses = torch.eye(4).expand(shown, 4, 4)
    views = Views(torch.ones(1, 3, side, side).expand(shown, -1, -1, -1), camera.pinhole(lens, poses, side, side))
    found = choose_representation(FIELD, views, cameras, representation, make=lambda *_: VOXELS)
    assert isinstance(found, BakedScene) == by_voxels
    assert choose_representation(found, views, cameras, representation) is found or not by_voxels


def test_the_number_of_voxels_depends_on_the_size_of_the_views():
    """More voxels would not help in larger pictures, because those between the rays of the views are not fitted."""
    lens, sides = camera.symmetric_intrinsics(64, 64, 0.8), []
    views = Views(torch.ones(25, 3, 64, 64), camera.pinhole(lens, torch.eye(4).expand(25, 4, 4), 64, 64))
    larger = camera.resized(camera.select(views.cameras, [0]), 256, 256)
    choose_representation(FIELD, views, larger, "voxels", make=lambda field, views, side: sides.append(side) or VOXELS)
    assert sides == [default_side((64, 64))]


def test_turntables_with_no_pixel_are_refused():
    for size in (0, -7):
        with pytest.raises(ValueError, match=f"size: expected at least 1 pixel, got {size}"):
            orbit_cameras(ball_views(ring(3, (8, 8))), 2, size=size)
