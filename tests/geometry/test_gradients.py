"""Source of truth: finite differences in float64 (gradcheck), of each part and of the whole renderer."""

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from hyperplanes.geometry import ImagePlanes, Rays, Sphere, cameras, cast
from hyperplanes.geometry.distortion import distorted
from hyperplanes.geometry.lookup import lookup
from hyperplanes.geometry.lookup_torch import interpolate, project
from hyperplanes.geometry.occupancy import full
from hyperplanes.rendering.renderer import Hierarchical, RayMarching, render


def small_scene(dtype=torch.float64):
    """Three 6 x 7 pictures, and points that are projected into them, away from pixel boundaries."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.tensor([[6.0, 0.0, 3.1], [0.0, 5.0, 2.4], [0.0, 0.0, 1.0]], dtype=dtype)
    pose = cameras.fibonacci_sphere(3, 2.5).to(dtype)
    images = torch.rand(3, 2, 6, 7, generator=generator, dtype=dtype)
    points = torch.rand(5, 3, generator=generator, dtype=dtype) * 0.8 - 0.4
    return points, matrix, pose, images


def moved(pose, shift):
    """Poses changed by a small rotation vector and a translation: (view, 6) -> camera_from_world."""
    generator = pose.new_zeros(len(pose), 4, 4)
    x, y, z = shift[:, :3].unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    generator = torch.cat([torch.cat([skew, shift[:, 3:, None]], 2), generator[:, 3:]], 1)
    return torch.linalg.matrix_exp(generator) @ pose


def grown(matrix, change):
    """Intrinsics with focal lengths and principal point changed by (4,) numbers."""
    zero = torch.zeros_like(change[0])
    rows = [
        torch.stack([change[0], zero, change[2]]),
        torch.stack([zero, change[1], change[3]]),
        torch.stack([zero] * 3),
    ]
    return matrix + torch.stack(rows)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("chosen", [False, True])
def test_lookup(backend, chosen):
    """With respect to points, images, intrinsics and extrinsics; for the last, also near the borders."""
    points, matrix, pose, images = small_scene()
    points = torch.cat([points, 4 * points])  # some outside the pictures, some behind the cameras
    views = torch.tensor([[0, 2], [1, 1]]).repeat(5, 1) if chosen else None

    def run(points, images, change, shift):
        ours = cameras.pinhole(grown(matrix, change), moved(pose, shift), 6, 7)
        found = ImagePlanes(images, ours, backend=backend).lookup(points, views, return_directions=True)
        return found.colours, found.coordinates, found.directions, found.distances

    small = torch.zeros(4, dtype=torch.float64), torch.zeros(3, 6, dtype=torch.float64)
    leaves = [value.clone().requires_grad_() for value in (points, images, *small)]
    assert gradcheck(run, leaves, fast_mode=True)


def test_project_and_sample():
    points, matrix, pose, images = small_scene()
    matrices = (matrix @ pose[:, :3]).requires_grad_()
    assert gradcheck(lambda p, m: project(p, m, None)[0], (points.requires_grad_(), matrices))
    coordinates = (torch.rand(5, 3, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5) * 1.9
    leaves = (images.requires_grad_(), coordinates.requires_grad_())
    assert gradcheck(lambda i, c: interpolate(i, c, None), leaves)
    views = torch.tensor([[0, 2, 1]]).expand(5, 3)
    assert gradcheck(lambda i, c: interpolate(i, c, views), leaves)


def test_second_derivatives_of_the_plain_backend():
    """MAML needs them, also with respect to the images."""
    points, matrix, pose, images = small_scene()
    matrices = matrix @ pose[:, :3]
    leaves = (points[:2].requires_grad_(), images.requires_grad_())
    assert gradgradcheck(lambda p, i: lookup(p, matrices, i, backend="torch").colours, leaves, fast_mode=True)


def test_rays():
    """Origins, directions, near and far with respect to pixels, intrinsics, extrinsics and the lens."""
    _, matrix, pose, _ = small_scene()
    pose, view = pose[:2], torch.tensor([0, 1, 1])
    pixels = torch.tensor([[3.0, 1.0], [4.6, 3.4], [3.3, 2.2]], dtype=torch.float64, requires_grad=True)

    def run(pixels, change, shift, lens):
        bare = cameras.pinhole(grown(matrix, change), moved(pose, shift), 6, 7)
        for ours in (bare, distorted(bare, lens)):
            for rays in (cast(ours, view, pixels), cast(cameras.select(ours, [1]), view[:1], pixels[:1])):
                yield from (rays.origins, rays.directions, rays.near, rays.far)

    lens = torch.tensor([-0.1, 0.02, 0.001, -0.002, 0.0], dtype=torch.float64, requires_grad=True)
    small = torch.zeros(4, dtype=torch.float64), torch.zeros(2, 6, dtype=torch.float64)
    leaves = (pixels, *(value.requires_grad_() for value in small), lens)
    assert gradcheck(lambda *values: tuple(run(*values)), leaves, fast_mode=True)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("sampling", [Hierarchical(5, 0), RayMarching(6)])
def test_the_whole_renderer(sampling, backend):
    """A field that looks colours up and has parameters: pixels with respect to cameras, images and parameters.

    RayMarching places samples at fixed distances: its step is the occupancy's, and where a ray meets the sphere decides
    without a gradient where the first one is. So rays keep their near and far there, while origins and directions move
    with the cameras.
    """
    _, matrix, pose, images = small_scene()
    view, pixels = torch.tensor([0, 1]), torch.tensor([[3.0, 2.0], [2.5, 3.1]], dtype=torch.float64)
    still = cast(cameras.pinhole(matrix, pose, 6, 7), view, pixels, Sphere())

    def run(images, change, shift, parameters):
        ours = cameras.pinhole(grown(matrix, change), moved(pose, shift), 6, 7)
        planes = ImagePlanes(images, ours, backend=backend)
        rays = cast(ours, view, pixels)
        if isinstance(sampling, RayMarching):
            rays = Rays(rays.origins, rays.directions, still.near, still.far)

        def field(points, directions):
            seen = planes.lookup(points).colours.mean(1)
            colour = torch.cat([seen, directions[:, :1].sigmoid()], -1)
            return colour * parameters[0], parameters[1] * torch.exp(-points.square().sum(-1) / parameters[2])

        rendered = render(field, rays, sampling, occupancy=full(Sphere(), 4))
        assert rendered.samples >= 6  # rays intersect the sphere, and keep their samples
        return rendered.colour, rendered.opacity, rendered.depth

    parameters = torch.tensor([0.9, 2.0, 0.3], dtype=torch.float64)
    small = torch.zeros(4, dtype=torch.float64), torch.zeros(3, 6, dtype=torch.float64)
    leaves = [value.clone().requires_grad_() for value in (images, *small, parameters)]
    assert gradcheck(run, leaves, fast_mode=True)
