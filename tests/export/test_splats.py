"""Splats of baked voxels: axes, conventions, and the pictures that a viewer makes of the files.

Source of truth: the formulas of "3D Gaussian Splatting" (Kerbl et al., 2023), written out here for a reader of the
file; the pictures of what was written; autograd.
"""

import numpy as np
import pytest
import torch
import trimesh

from hyperplanes.export.splats import Splats, fit_splats, save_splats, splats_of
from hyperplanes.fields.baked import BakedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.rays import Sphere, pixel_grid
from hyperplanes.rendering.splats import splat_gradients
from hyperplanes.utilities.metrics import psnr
from hyperplanes.views import Views

SIZE = 40
CAMERAS = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), camera.fibonacci_sphere(6, 3.0), SIZE, SIZE)
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))  # a viewer's world, y down, from ours


@pytest.fixture(scope="module")
def splats():
    """A ball of voxels whose colour depends on place and, in all nine harmonics, on direction."""
    side = 16
    axis = (torch.arange(side) + 0.5) / side * 2 - 1
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    filled = (points - torch.tensor([0.1, 0.2, -0.1])).norm(dim=-1) < 0.6
    index = torch.full((side,) * 3, -1, dtype=torch.int32)
    index[filled] = torch.arange(int(filled.sum()), dtype=torch.int32)
    values = 0.1 * torch.randn(int(filled.sum()), 28, generator=torch.Generator().manual_seed(0))
    values[:, 0] = 30.0
    values[:, [1, 10, 19]] = 1.7 * (0.5 + 0.4 * torch.sin(3 * points[filled]))
    return splats_of(BakedField(index, values, Sphere()))


def read(path):
    """What a viewer makes of a PLY of splats: means, sizes, opacities, and colours by direction (Kerbl et al.)."""
    data = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    column = lambda *names: torch.tensor(np.stack([data[name] for name in names], -1).astype(np.float32))  # noqa: E731
    means, first = column("x", "y", "z"), column("f_dc_0", "f_dc_1", "f_dc_2")
    rest = column(*[f"f_rest_{place}" for place in range(45)]).reshape(-1, 3, 15)

    def colours(origin):
        x, y, z = torch.nn.functional.normalize(means - origin, dim=-1).T[:, :, None]
        part = rest.unbind(-1)
        seen = 0.28209479177387814 * first + 0.4886025119029199 * (-y * part[0] + z * part[1] - x * part[2])
        seen = seen + 1.0925484305920792 * (x * y * part[3] - y * z * part[4] - x * z * part[6])
        seen = seen + 0.31539156525252005 * (2 * z * z - x * x - y * y) * part[5]
        return (seen + 0.5462742152960396 * (x * x - y * y) * part[7] + 0.5).clamp(0, 1)

    assert not rest[..., 8:].any()
    assert torch.equal(column("rot_0", "rot_1", "rot_2", "rot_3")[0], torch.tensor([1.0, 0.0, 0.0, 0.0]))
    return means, column("scale_0").exp()[:, 0], torch.sigmoid(column("opacity"))[:, 0], colours


def test_a_viewer_of_the_file_sees_the_same_pictures_with_y_down(splats, tmp_path):
    from hyperplanes.rendering.splats import render_splats

    means, sizes, opacities, colours = read(save_splats(splats, tmp_path / "ball.ply"))
    assert torch.allclose(means, splats.means @ DOWN[:3, :3], atol=1e-6)
    for view in range(2):
        one = camera.select(CAMERAS, [view])
        there = camera.with_poses(one, one.extrinsics @ DOWN)
        found = render_splats(means, sizes, opacities, colours(camera.centres(there)), there)
        torch.testing.assert_close(found, splats.render(one)[0], atol=1e-4, rtol=0)


def test_the_small_format(splats, tmp_path):
    content = save_splats(splats, tmp_path / "ball.splat").read_bytes()
    assert len(content) == 32 * len(splats.means)
    means = np.frombuffer(content, "<f4").reshape(-1, 8)[:, :3]
    wanted = (splats.means @ DOWN[:3, :3]).numpy()
    assert np.allclose(np.sort(means, axis=0), np.sort(wanted, axis=0))
    with pytest.raises(ValueError, match=r"ball\.obj: expected a name that ends in ply, splat, got 'obj'"):
        save_splats(splats, tmp_path / "ball.obj")


def composited(means, sizes, opacities, colours, one):
    """The picture by autograd: each splat over all pixels, in the order of depth, with the kernel's thresholds."""
    matrix, pose = camera.intrinsics(one)[0], camera.camera_from_world(one)[0]
    local = means @ pose[:3, :3].T + pose[:3, 3]
    pixels = pixel_grid(*camera.image_size(one))
    picture, left = torch.zeros(len(pixels), 3), torch.ones(len(pixels), 1)
    for splat in torch.argsort(local[:, 2]):
        x, y, z = local[splat]
        fx, fy = matrix[0, 0], matrix[1, 1]
        jacobian = torch.stack(
            [fx * torch.stack([1 / z, 0 * z, -x / z**2]), fy * torch.stack([0 * z, 1 / z, -y / z**2])]
        )
        covariance = sizes[splat] ** 2 * jacobian @ jacobian.T + 0.3 * torch.eye(2)
        away = pixels - torch.stack([fx * x / z + matrix[0, 2], fy * y / z + matrix[1, 2]])
        power = (away @ torch.linalg.inv(covariance) * away).sum(-1, keepdim=True)
        inside = away.abs().amax(-1, keepdim=True) <= 3 * covariance.diagonal().max().sqrt()
        alpha = (opacities[splat] * torch.exp(-power / 2)).clamp_max(0.99)
        alpha = torch.where(inside & (alpha >= 1 / 255), alpha, 0.0)
        picture, left = picture + left * alpha * colours[splat], left * (1 - alpha)
    return (picture + left).T.reshape(3, *camera.image_size(one))


def test_gradients_are_those_of_autograd():
    generator = torch.Generator().manual_seed(1)
    means, sizes = 0.4 * torch.randn(5, 3, generator=generator), torch.full((5,), 0.3)
    opacities = (0.2 + 0.6 * torch.rand(5, generator=generator)).requires_grad_()
    colours = torch.rand(5, 3, generator=generator).requires_grad_()
    one = camera.pinhole(camera.symmetric_intrinsics(12, 12, 0.7), camera.fibonacci_sphere(3, 3.0)[1:2], 12, 12)
    truth = torch.rand(3, 12, 12, generator=generator)
    wanted = (composited(means, sizes, opacities, colours, one) - truth).square().mean()
    wanted.backward()
    error, *found = splat_gradients(means, sizes, opacities.detach(), colours.detach(), one, truth)
    assert error == pytest.approx(float(wanted.detach()), rel=1e-5)
    torch.testing.assert_close(found, [opacities.grad, colours.grad], rtol=1e-3, atol=1e-6)


def test_fitting_brings_back_the_colours(splats):
    truth = splats.render(CAMERAS)
    faded = Splats(splats.means, splats.sizes, splats.logits, 0.9 * splats.coefficients)
    before = float(psnr(faded.render(CAMERAS), truth).mean())
    fitted = fit_splats(faded, Views(truth, CAMERAS), steps=18)
    assert float(psnr(fitted.render(CAMERAS), truth).mean()) > before + 3
