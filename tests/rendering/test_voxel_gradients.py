"""Source of truth: autograd through the same voxels, as a field in the generic renderer with the same samples."""

import pytest
import torch

from hyperplanes.fields.baked import BakedField, spherical_harmonics
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid
from hyperplanes.rendering.renderer import RayMarching, render
from hyperplanes.rendering.voxels import VoxelGrid, voxel_gradients


@pytest.mark.parametrize("counts", [None, [1, 5, 2] * 16])
def test_the_compiled_gradient_agrees_with_autograd(counts):
    generator = torch.Generator().manual_seed(0)
    filled = torch.rand(8, 8, 8, generator=generator) < 0.4
    index = torch.full((8, 8, 8), -1, dtype=torch.int32)
    index[filled] = torch.arange(int(filled.sum()), dtype=torch.int32)
    values = 0.3 * torch.randn(int(filled.sum()), 28, generator=generator)
    values[:, 0] = 4 * values[:, 0].abs()
    values[:, [1, 10, 19]] += 1.5
    cameras = camera.pinhole(camera.symmetric_intrinsics(8, 8, 0.9), camera.fibonacci_sphere(2, 3.0), 8, 8)
    pixels = pixel_grid(8, 8)
    rays = cast(cameras, torch.arange(2).repeat_interleave(64), pixels.repeat(2, 1))
    counts = None if counts is None else torch.tensor(counts)
    pixel = torch.arange(128) if counts is None else torch.arange(48).repeat_interleave(counts)
    truth = torch.rand(int(pixel.max()) + 1, 3, generator=generator)
    error, found = voxel_gradients(
        VoxelGrid.of(index, Sphere()),
        values,
        rays,
        spherical_harmonics(rays.directions),
        truth,
        step=2 / 24,
        counts=counts,
    )
    wanted = values.clone().requires_grad_()
    field = BakedField(index, wanted, Sphere())
    colours = render(field, rays, RayMarching(24, 1e-3), occupancy=field.occupancy).colour
    means = torch.zeros_like(truth).index_add(0, pixel, colours) / pixel.bincount()[:, None]
    expected = (means - truth).square().mean()
    expected.backward()
    assert error == pytest.approx(float(expected.detach()), rel=1e-4)
    assert wanted.grad is not None
    torch.testing.assert_close(found, wanted.grad, rtol=1e-3, atol=2e-6)
