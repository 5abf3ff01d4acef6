"""Source of truth: the plain backend. The tests need Triton, and a GPU or TRITON_INTERPRET=1."""

import os

import pytest
import torch

from hyperplanes.geometry import cameras, lookup_torch

pytest.importorskip("triton", reason="needs Triton")
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


@pytest.mark.skipif(not (INTERPRETED or torch.cuda.is_available()), reason="needs a CUDA device or TRITON_INTERPRET=1")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("chosen", [False, True])
def test_values_and_gradients_are_those_of_plain_torch(dtype, chosen):
    from hyperplanes.geometry.kernels.lookup import lookup_triton

    device = "cpu" if INTERPRETED else "cuda"
    generator = torch.Generator().manual_seed(0)
    matrix = torch.tensor([[14.0, 0.3, 5.1], [0.0, 11.0, 4.7], [0.0, 0.0, 1.0]])
    ours = cameras.pinhole(matrix, cameras.fibonacci_sphere(4, 2.5), 9, 13)
    images = torch.nn.functional.avg_pool2d(torch.rand(4, 3, 9, 13, generator=generator), 3, 1, 1)
    points = 1.5 * torch.randn(150, 3, generator=generator)
    views = torch.randint(0, 4, (150, 2), generator=generator).to(device) if chosen else None
    leaves = [value.to(device, dtype).requires_grad_() for value in (points, cameras.projection_matrices(ours), images)]
    bare = [leaf.detach() for leaf in leaves]
    expected = lookup_torch.lookup(*leaves, views, 0.3)
    found = lookup_triton.lookup(*bare, views, 0.3)
    tolerance = 1e-4 if dtype == torch.float32 else 1e-10
    assert torch.equal(found[2], expected[2])
    for mine, plain in zip(found[:2], expected[:2], strict=True):
        torch.testing.assert_close(mine, plain.detach(), atol=tolerance, rtol=0)
    pulls = [torch.randn(value.shape, generator=generator).to(device, dtype) for value in expected[:2]]
    gradients = torch.autograd.grad(expected[:2], leaves, pulls)
    mine = lookup_triton.lookup_backward(*bare, views, *pulls, True, True)
    for ours_, plain in zip(mine, gradients, strict=True):
        torch.testing.assert_close(ours_, plain, atol=10 * tolerance, rtol=tolerance)
