"""Sources of truth: closed forms of z, positions and normals of a plane and a sphere."""

import math

import torch

from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import distorted
from hyperplanes.geometry.rays import cast, pixel_grid
from hyperplanes.rendering.depth import seen_surface
from hyperplanes.rendering.images import Pictures

SIZE = 48
CAMERAS = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), camera.fibonacci_sphere(3, 3.0), SIZE, SIZE)


def pictured(cameras, distances):
    """Pictures with the given depths along rays; infinity means empty."""
    count, pixels = cameras.batch_size, pixel_grid(SIZE, SIZE)
    view = torch.arange(count).repeat_interleave(len(pixels))
    depth = distances(cast(cameras, view, pixels.repeat(count, 1))).reshape(count, 1, SIZE, SIZE)
    seen = depth.isfinite()
    return Pictures(torch.ones(count, 3, SIZE, SIZE), seen.float(), torch.where(seen, depth, 0.0), 0)


def ball(radius):
    def distances(rays):
        middle = -(rays.origins * rays.directions).sum(-1)
        square = radius**2 - rays.origins.square().sum(-1) + middle**2
        return torch.where(square > 0, middle - square.clamp_min(0).sqrt(), torch.inf)

    return distances


def plane(normal, offset):
    def distances(rays):
        found = (offset - rays.origins @ normal) / (rays.directions @ normal)
        return torch.where(found > 0, found, torch.inf)

    return distances


def test_a_plane_has_one_normal_whatever_the_lens():
    normal = torch.nn.functional.normalize(torch.tensor([0.3, 1.0, 0.2]), dim=0)
    for cameras in (CAMERAS, distorted(CAMERAS, torch.tensor([0.2, -0.1, 0.0, 0.01, 0.02]))):
        surface = seen_surface(pictured(cameras, plane(normal, 0.2)), cameras)
        seen = surface.covered > 0
        # where the plane is neither too far nor too oblique
        steady = seen & (surface.z < 6) & ((surface.normals @ normal).abs() > 0)
        assert steady.sum() > 1000
        cosine = (surface.normals[steady] @ normal).abs()
        oblique = ((surface.points - camera.centres(cameras)[:, None, None]) @ normal).abs()[steady]
        assert torch.rad2deg(torch.acos(cosine.clamp_max(1)))[oblique > 0.5].max() < 0.5
        torch.testing.assert_close(
            surface.points[seen] @ normal, torch.full((int(seen.sum()),), 0.2), atol=1e-3, rtol=0
        )


def test_positions_and_normals_of_a_sphere():
    """A pixel is 1.5 % of the distance wide, which is 0.9 degrees in the middle of the sphere."""
    surface = seen_surface(pictured(CAMERAS, ball(0.8)), CAMERAS)
    seen = surface.covered > 0
    assert math.isclose(float(seen[0].float().mean()), math.pi * 0.8**2 / (3**2 - 0.8**2) / 4 / math.tan(0.35) ** 2,
                        rel_tol=0.02)  # fmt: skip
    torch.testing.assert_close(
        surface.points[seen].norm(dim=-1), torch.full((int(seen.sum()),), 0.8), atol=1e-4, rtol=0
    )
    local = camera.camera_from_world(CAMERAS)[:, 2]
    expected = (surface.points * local[:, None, None, :3]).sum(-1) + local[:, None, None, 3]
    torch.testing.assert_close(surface.z[seen], expected[seen], atol=1e-4, rtol=0)
    angle = torch.rad2deg(torch.acos((surface.normals[seen] * surface.points[seen] / 0.8).sum(-1).clamp_max(1)))
    assert angle.median() < 1
    assert angle.max() < 20  # at the outline, where half of the neighbouring pixels are missing
    assert not surface.normals[~seen].any()
    assert not surface.z[~seen].any()
