"""Sources of truth: operands rounded as in TF32, and PyTorch's own setting, without a GPU."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import linear

from hyperplanes.adaptation.alignment.rotation import Rotation
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.fields import base
from hyperplanes.geometry import occupancy
from hyperplanes.geometry.cameras import (
    camera_from_world,
    centres,
    look_at,
    moved,
    pinhole,
    projection_matrices,
    resized,
    select,
    symmetric_intrinsics,
)
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import carve, full
from hyperplanes.geometry.poses import farthest_first, outermost_first
from hyperplanes.geometry.rays import Sphere
from hyperplanes.geometry.symmetry.reflections import rotation_about
from hyperplanes.rendering import footprint as footprints
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.renderer import allow_tf32
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views
from tests.reference_rendering import awaken, ball_views, ring, small_model


def test_tf32_is_allowed_only_on_a_gpu_and_inside_the_context():
    before = torch.get_float32_matmul_precision()
    for name, expected in (("cpu", before), ("cuda", "high")):
        with allow_tf32(torch.device(name)):
            assert torch.get_float32_matmul_precision() == expected
        assert torch.get_float32_matmul_precision() == before


def test_the_last_of_overlapping_contexts_restores_the_setting():
    # Contexts of two threads need not end in reverse order.
    before, gpu = torch.get_float32_matmul_precision(), torch.device("cuda")
    first, second = allow_tf32(gpu), allow_tf32(gpu)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert torch.get_float32_matmul_precision() == "high"
    second.__exit__(None, None, None)
    assert torch.get_float32_matmul_precision() == before


def test_tf32_products_hardly_change_pictures(monkeypatch):
    # Source of truth: operands rounded to 10 bits of mantissa, as tensor cores do.
    model = HyperPlanes.from_pretrained("cars-64")
    model.config = replace(model.config, hull_resolution=24)
    generator = torch.Generator().manual_seed(0)
    views = Views(torch.rand(25, 3, 32, 32, generator=generator), ring(25, (32, 32)), torch.ones(25, 1, 32, 32))
    cameras = resized(select(views.cameras, [9]), 12, 12)
    field = model.adapt(views)
    exact = field.render(cameras).images

    def rounded(value):
        bits = value.contiguous().view(torch.int32)
        return (bits + (1 << 12) >> 13 << 13).view(torch.float32)

    monkeypatch.setattr(base, "linear", lambda x, weight, bias: linear(rounded(x), rounded(weight), bias))
    short = field.render(cameras).images
    assert exact.std() > 0.02
    assert not torch.equal(short, exact)
    assert psnr(short, exact).min() > 60


@pytest.mark.parametrize("compiled", [True, False])
def test_geometry_has_full_precision_under_autocast(monkeypatch, compiled):
    """In bfloat16, projections would be wrong by pixels, and rotation matrices would not be orthogonal."""
    if not compiled:
        for module in (occupancy, footprints):
            monkeypatch.setattr(module, "find_spec", lambda name: None)
    views, grid = ball_views(ring(5, (200, 200))), full(Sphere(), 24)
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    eyes = torch.nn.functional.normalize(points, dim=1)

    def found():
        cameras = pinhole(symmetric_intrinsics(200, 200, 0.7), look_at(3 * eyes[:9]), 200, 200)
        planes = ImagePlanes(views.images, views.cameras, backend=None if compiled else "torch")
        seen = planes.lookup(points, return_directions=True)
        hull = carve(views.masks, views.cameras, views.bounds, 24).occupied
        chosen = torch.tensor([farthest_first(eyes, 0, 100), [outermost_first(eyes[k:], 1)[0] for k in range(100)]])
        turned = camera_from_world(moved(cameras, rotation_about((0.1, 0.2, 0.3), 0.5)))
        where = [centres(cameras), projection_matrices(cameras), footprint(grid, cameras), chosen, turned]
        return [*where, seen.colours, seen.directions, seen.coordinates, hull]

    expected = found()
    with torch.autocast("cpu", torch.bfloat16):
        assert all(torch.equal(*each) for each in zip(found(), expected, strict=True))


def test_autocast_does_not_change_fields():
    views = ball_views(ring(6, (16, 16)))
    model = HyperPlanes.from_pretrained("small")
    model.config = replace(model.config, hull_resolution=16, symmetric=False, azimuth=0.0, learned_steps=0)
    field = model.adapt(views)
    by_pytorch = awaken(small_model()).eval().adapt(views)  # layers too narrow for kernels
    for each in (by_pytorch, field, Rotation(0.3).field(field)):
        rays = views.rays(0)
        points = rays.at(torch.full((len(rays),), 3.0))

        def found(field=each, rays=rays, points=points):
            seen = field.trace(rays, differentiable=False).colour
            return [seen, field.density(points), *field(points, rays.directions)]

        expected = found()
        with torch.autocast("cpu", torch.bfloat16):
            assert all(torch.equal(*pair) for pair in zip(found(), expected, strict=True))


def test_autocast_does_not_change_adapting_and_rendering():
    """In bfloat16, directions of rays are wrong by most of a pixel."""
    generator = torch.Generator().manual_seed(0)
    masks = torch.zeros(9, 1, 16, 16)
    masks[:, :, 6:10, 6:10] = 1.0
    views = Views(torch.rand(9, 3, 16, 16, generator=generator), ring(9, (16, 16)), masks)
    one = views[[0, 3, 6]]
    rays = one.rays(0).directions
    for name, shown in (("cars-64", views), ("small", one)):
        model = HyperPlanes.from_pretrained(name)
        model.config = replace(model.config, hull_resolution=16, learned_steps=model.config.learned_steps and 1)
        field = model.adapt(shown)
        with torch.autocast("cpu", torch.bfloat16):
            within = model.adapt(shown)
            assert torch.equal(within.render(one.cameras).images, field.render(one.cameras).images)
            assert torch.equal(one.rays(0).directions, rays)
        assert torch.equal(within.render(one.cameras).images, field.render(one.cameras).images)


def test_autocast_does_not_change_prepared_and_swapped_objects():
    model = awaken(small_model()).eval()
    objects = [ball_views(ring(4, (16, 16)), colour=colour) for colour in ((0.8, 0.2, 0.1), (0.1, 0.9, 0.3))]
    prepared = model.prepare(objects[0])

    def found():
        fields = model.adapt_to(prepared), Swapped(model, objects).adapt(objects[0])
        return [each.render(objects[0].cameras).images for each in fields]

    expected = found()
    with torch.autocast("cpu", torch.bfloat16):
        assert all(torch.equal(*pair) for pair in zip(found(), expected, strict=True))
