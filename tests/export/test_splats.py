"""Splats of baked voxels: axes, conventions, and pictures that a viewer renders from the files.

Source of truth: the formulas of "3D Gaussian Splatting" (Kerbl et al., 2023), written out here for a reader of the
file; the pictures of what was written; autograd.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from hyperplanes.export.splats import fit_splats, save_splats, splats_of
from hyperplanes.fields.baked import BakedField
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import DistortedCamera
from hyperplanes.geometry.rays import Sphere, pixel_grid
from hyperplanes.rendering.splats import render_splats, rotations_of
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views

SIZE = 40
CAMERAS = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), camera.fibonacci_sphere(6, 3.0), SIZE, SIZE)
DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))  # world of a viewer, with y down, from our world


@pytest.fixture(scope="module")
def splats():
    """A ball of voxels whose colour depends on position and, with nine spherical harmonics, on direction."""
    side = 16
    axis = (torch.arange(side) + 0.5) / side * 2 - 1
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    filled = (points - torch.tensor([0.1, 0.2, -0.1])).norm(dim=-1) < 0.6
    index = torch.full((side,) * 3, -1, dtype=torch.int32)
    index[filled] = torch.arange(int(filled.sum()), dtype=torch.int32)
    values = 0.1 * torch.randn(int(filled.sum()), 28, generator=torch.Generator().manual_seed(0))
    values[:, 0] = 30.0
    values[:, [1, 10, 19]] = 1.7 * (0.5 + 0.4 * torch.sin(3 * points[filled]))
    round_ones = splats_of(BakedField(index, values, Sphere()))
    generator = torch.Generator().manual_seed(1)
    scales = 2 * round_ones.scales * torch.rand(len(values), 3, generator=generator).add(0.3)
    return replace(round_ones, scales=scales, quaternions=torch.randn(len(values), 4, generator=generator))


def read(path):
    """Read a PLY of splats as a viewer does: means, scales, rotations, opacities, colours by origin (Kerbl et al.)."""
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
        return (seen + 0.5462742152960396 * (x * x - y * y) * part[7] + 0.5).clamp_min(0)

    assert not rest[..., 8:].any()
    scales, quaternions = column("scale_0", "scale_1", "scale_2").exp(), column("rot_0", "rot_1", "rot_2", "rot_3")
    return means, scales, quaternions, torch.sigmoid(column("opacity"))[:, 0], colours


def test_a_viewer_renders_the_same_pictures_from_the_file_with_y_down(splats, tmp_path):
    means, scales, quaternions, opacities, colours = read(save_splats(splats, tmp_path / "ball.ply"))
    assert torch.allclose(means, splats.means @ DOWN[:3, :3], atol=1e-6)
    for view in range(2):
        one = camera.select(CAMERAS, [view])
        there = camera.with_poses(one, one.extrinsics @ DOWN)
        found = render_splats(means, scales, quaternions, opacities, colours(camera.centres(there)), there)
        torch.testing.assert_close(found, splats.render(one)[0], atol=1e-4, rtol=0)


def test_the_small_format(splats, tmp_path):
    content = save_splats(splats, tmp_path / "ball.splat").read_bytes()
    assert len(content) == 32 * len(splats.means)
    rows = np.frombuffer(content, "<f4").reshape(-1, 8)
    wanted = (splats.means @ DOWN[:3, :3]).numpy()
    order = [int(np.abs(wanted - mean).sum(1).argmin()) for mean in rows[:20, :3]]
    np.testing.assert_allclose(rows[:20, :3], wanted[order], atol=1e-6)
    np.testing.assert_allclose(rows[:20, 3:6], splats.scales[order].numpy(), rtol=1e-6)
    turned = (np.frombuffer(content, "u1").reshape(-1, 32)[:20, 28:].astype(np.float32) - 128) / 128
    expected = DOWN[:3, :3] @ rotations_of(splats.quaternions[order])
    torch.testing.assert_close(rotations_of(torch.from_numpy(turned)), expected, atol=0.05, rtol=0)
    with pytest.raises(ValueError, match=r"ball\.obj: expected a name that ends in ply, splat, got 'obj'"):
        save_splats(splats, tmp_path / "ball.obj")


def composited(splats, opacities, colours, one):
    """A picture in PyTorch: all splats in order of depth over all pixels, with the thresholds of the kernel."""
    matrix, pose = camera.intrinsics(one)[0], camera.camera_from_world(one)[0]
    means, scales, quaternions = splats
    local = means @ pose[:3, :3].T + pose[:3, 3]
    pixels = pixel_grid(*camera.image_size(one)).to(means)
    picture, left = means.new_zeros(len(pixels), 3), means.new_ones(len(pixels), 1)
    for splat in torch.argsort(local[:, 2]):
        x, y, z = local[splat]
        fx, fy = matrix[0, 0], matrix[1, 1]
        right, down = torch.stack([1 / z, 0 * z, -x / z**2]), torch.stack([0 * z, 1 / z, -y / z**2])
        jacobian = torch.stack([fx * right + matrix[0, 1] * down, fy * down])
        axes = pose[:3, :3] @ rotations_of(quaternions[splat][None])[0]
        covariance = jacobian @ axes @ torch.diag(scales[splat] ** 2) @ axes.T @ jacobian.T + 0.3 * torch.eye(2).to(
            means
        )
        away = pixels - one.project(means[splat][None])[0]
        power = (away @ torch.linalg.inv(covariance) * away).sum(-1, keepdim=True)
        inside = away.abs().amax(-1, keepdim=True) <= 3 * covariance.diagonal().max().sqrt()
        alpha = (opacities[splat] * torch.exp(-power / 2)).clamp_max(0.99)
        alpha = torch.where(inside & (alpha >= 1 / 255), alpha, 0.0)
        picture, left = picture + left * alpha * colours[splat], left * (1 - alpha)
    return (picture + left).T.reshape(3, *camera.image_size(one))


@pytest.mark.parametrize("skew", [0.0, 4.0])
def test_the_picture_and_its_gradients_agree_with_autograd(skew):
    generator = torch.Generator().manual_seed(1)
    parts = [
        0.4 * torch.randn(5, 3, generator=generator),
        0.2 + 0.3 * torch.rand(5, 3, generator=generator),
        torch.randn(5, 4, generator=generator),
        0.2 + 0.6 * torch.rand(5, generator=generator),
        torch.rand(5, 3, generator=generator),
    ]
    one = camera.pinhole(camera.symmetric_intrinsics(12, 12, 0.7), camera.fibonacci_sphere(3, 3.0)[1:2], 12, 12)
    one.intrinsics[:, 0, 1] = skew
    truth = torch.rand(3, 12, 12, generator=generator)
    gradients, pictures = [], []
    for draw in (lambda *each: composited(each[:3], *each[3:], one), lambda *each: render_splats(*each, one)):
        leaves = [part.clone().requires_grad_() for part in parts]
        pictures.append(draw(*leaves))
        (pictures[-1] - truth).square().mean().backward()
        gradients.append([leaf.grad for leaf in leaves])
    torch.testing.assert_close(pictures[1], pictures[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(render_splats(*parts, camera.to(one, dtype=torch.float64)), pictures[1].detach())
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("z", [0.3, 0.01, 5e-4, 2e-4])
def test_a_splat_beside_the_camera_is_not_in_the_picture(z):
    """Its centre is at least 25 standard deviations away from the pyramid of rays."""
    one = camera.pinhole(camera.symmetric_intrinsics(16, 16, 0.8), torch.eye(4)[None], 16, 16)
    parts = [
        torch.tensor([[0.5, 0.0, z]]),
        torch.full((1, 3), 0.01),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([0.9]),
        torch.zeros(1, 3),
    ]
    leaves = [part.requires_grad_() for part in parts]
    picture = render_splats(*leaves, one)
    assert torch.equal(picture, torch.ones_like(picture))
    picture.sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)


@pytest.mark.parametrize("unit", [1e-7, 1e4])
def test_splats_do_not_depend_on_the_unit_of_the_world(splats, unit):
    scaled = replace(splats, means=unit * splats.means, scales=unit * splats.scales)
    poses = CAMERAS.extrinsics.clone()
    poses[:, :3, 3] *= unit
    found = scaled.render(camera.with_poses(CAMERAS, poses))
    torch.testing.assert_close(found, splats.render(CAMERAS), atol=1e-2, rtol=0)


def test_fitting_restores_changed_splats(splats):
    """Splats that are faded, moved and enlarged give the same pictures after fitting, with hidden ones removed."""
    truth = splats.render(CAMERAS)
    generator = torch.Generator().manual_seed(2)
    spoilt = replace(
        splats,
        means=splats.means + 0.02 * torch.randn(splats.means.shape, generator=generator),
        scales=1.5 * splats.scales,
        coefficients=0.9 * splats.coefficients,
    )
    before = float(psnr(spoilt.render(CAMERAS), truth).mean())
    fitted = fit_splats(spoilt, Views(truth.clamp(0, 1), CAMERAS), steps=24)
    assert float(psnr(fitted.render(CAMERAS), truth).mean()) > before + 5
    assert len(splats.means) / 2 < len(fitted.means) < len(splats.means)
    assert fit_splats(spoilt, Views(truth.clamp(0, 1), CAMERAS), steps=0) is spoilt


def test_a_guide_preserves_parts_that_few_views_do_not_show(splats):
    """One darker view: without the guide, PSNR of other views decreases; with it, it decreases less."""
    truth = splats.render(CAMERAS)
    shown = Views(0.8 * truth.clamp(0, 1), CAMERAS)[:1]
    guide = Views(truth.clamp(0, 1), CAMERAS)[1:4]
    alone, guided = (fit_splats(splats, shown, guide=each, steps=16) for each in (None, guide))
    lost = [float(psnr(each.render(CAMERAS)[4:], truth[4:]).mean()) for each in (alone, guided)]
    assert lost[1] > lost[0] + 1
    with pytest.raises(ValueError, match=r"guide: expected renderings of the views' size \(40, 40\), got \(20, 20\)"):
        fit_splats(splats, shown, guide=guide.resized(20), steps=1)


def test_views_that_cannot_be_fitted_are_refused(splats):
    views = Views(torch.zeros(6, 3, SIZE, SIZE), CAMERAS)
    distorted = Views(views.images, DistortedCamera(CAMERAS, torch.zeros(6, 5)))
    for wrong in (views[:0], distorted):
        with pytest.raises(ValueError, match="views: expected at least one without lens distortion"):
            fit_splats(splats, wrong, steps=1)
