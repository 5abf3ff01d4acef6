"""Sources of truth: the baked fields, the Beer-Lambert law for a slab, packed PyTorch, and saved files."""

import math
from dataclasses import replace
from threading import Thread

import pytest
import torch
from torch.nn.functional import avg_pool2d

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export import baking, voxel_fitting
from hyperplanes.export.baking import BakedScene, _resampled, bake
from hyperplanes.export.voxel_fitting import fit_voxels, render_guide
from hyperplanes.fields.baked import BakedField, spherical_harmonics
from hyperplanes.geometry import Sphere
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import Occupancy, full
from hyperplanes.geometry.rays import Rays, cast
from hyperplanes.rendering.renderer import RayMarching, render
from hyperplanes.rendering.transmittance import transmittance
from hyperplanes.rendering.voxels import STOP_TRANSMITTANCE, VoxelGrid, distance_to_filled, render_voxels, shade_voxels
from hyperplanes.utilities.files.checkpoints import CheckpointError
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views

CAMERAS = camera.pinhole(camera.symmetric_intrinsics(48, 48, 0.7), camera.fibonacci_sphere(6, 3.0), 48, 48)


def soft_ball(points, directions):
    """A ball with a soft surface, whose colour depends on position and slightly on direction."""
    density = 40 * torch.sigmoid((0.6 - points.norm(dim=-1)) * 30)
    colour = 0.5 + 0.3 * torch.sin(2 * points) + 0.15 * directions
    return colour.clamp(0, 1), density


@pytest.fixture(scope="module")
def adapted():
    return AdaptedField(soft_ball, full(Sphere(), 48), RayMarching(128))


@pytest.fixture(scope="module")
def baked(adapted):
    return bake(adapted, side=64)


@pytest.fixture(scope="module")
def seen(adapted):
    """Pictures of the field."""
    return adapted.render(CAMERAS)


@pytest.fixture(scope="module")
def coarse(adapted):
    return bake(adapted, side=32)


@pytest.fixture(scope="module")
def other_views(adapted):
    """Pictures of the field from other cameras."""
    cameras = camera.pinhole(camera.symmetric_intrinsics(48, 48, 0.7), camera.fibonacci_sphere(3, 3.0), 48, 48)
    return Views(adapted.render(cameras).images, cameras)


def quality_of(field, views):
    """PSNR of the pictures of baked voxels in dB."""
    return float(psnr(BakedScene(field).render(views.cameras).images, views.images).mean())


def test_harmonics_are_orthonormal():
    # Source of truth: the integral over the sphere, with evenly distributed directions.
    directions = camera.fibonacci_sphere(20_000, 1.0)[:, 2, :3]
    basis = spherical_harmonics(directions)
    gram = basis.T @ basis * (4 * math.pi / len(directions))
    assert torch.allclose(gram, torch.eye(9), atol=2e-3)


def test_baked_pictures_have_more_rays_at_edges(baked, monkeypatch):
    monkeypatch.setattr(baking, "BAKED_EDGE_THRESHOLD", 0.2)  # the ball is soft
    found = BakedScene(baked).render(CAMERAS)
    monkeypatch.setattr(baking, "BAKED_EDGE_THRESHOLD", math.inf)
    plain = BakedScene(baked).render(CAMERAS)
    assert found.samples > plain.samples
    assert not torch.equal(found.opacity, plain.opacity)


def test_baked_pictures_agree_with_the_field(seen, baked):
    # Source of truth: the field itself, rendered by marching.
    truth = seen
    found = BakedScene(baked, steps=256).render(CAMERAS)
    assert float(psnr(found.images, truth.images).min()) > 34
    hit = truth.opacity > 0.99
    assert float((found.depth - truth.depth)[hit].abs().mean()) < 0.02


def test_the_compiled_caster_agrees_with_packed_torch(baked):
    # Source of truth: the same voxels as a field in the generic renderer, with the same steps.
    scene = BakedScene(baked)
    sampling, cameras = RayMarching(scene.steps, STOP_TRANSMITTANCE), camera.select(CAMERAS, [2, 5])
    generic = render(baked, cameras, sampling, bounds=baked.occupancy.bounds, occupancy=baked.occupancy)
    compiled = scene.render(cameras)
    assert float((generic.images - compiled.images).abs().max()) < 5e-3
    assert float((generic.images - compiled.images).abs().mean()) < 1e-4


def test_shaded_voxels_have_the_colours_of_rays_through_their_centres(baked):
    # Source of truth: the spherical harmonics of each direction.
    eye = torch.tensor([0.5, -2.0, 1.0])
    found = shade_voxels(baked.values, baked.centres(), eye)
    basis = spherical_harmonics(torch.nn.functional.normalize(baked.centres() - eye, dim=-1))
    density, coefficients = baked.values[:, :1], baked.values[:, 1:].unflatten(1, (3, 9))
    expected = torch.cat([density, density * (coefficients * basis[:, None]).sum(-1)], 1)
    torch.testing.assert_close(found[:-1], expected, rtol=1e-4, atol=1e-4)
    assert not found[-1].any()  # the row for empty voxels


def test_a_grid_is_the_bounding_box_of_its_voxels_with_an_empty_border(baked):
    grid = VoxelGrid.of(baked.index, baked.bounds)
    places = (grid.rows >= 0).nonzero()
    assert places.amin(0).tolist() == [1, 1, 1]
    assert (places.amax(0) + 2).tolist() == list(grid.rows.shape)
    centres = torch.empty_like(baked.centres())
    centres[grid.rows[grid.rows >= 0].long()] = grid.first + places * grid.voxel
    torch.testing.assert_close(centres, baked.centres(), rtol=0, atol=1e-5)


def test_a_grid_without_voxels_is_background():
    index = torch.full((8, 8, 8), -1, dtype=torch.int32)
    rays = cast(CAMERAS, torch.zeros(1, dtype=torch.long), torch.tensor([[9.0, 9.0]]))
    shaded = shade_voxels(torch.zeros(0, 28), torch.zeros(0, 3), rays.origins[0])
    seen = render_voxels(VoxelGrid.of(index, Sphere()), shaded, rays, step=0.01)
    assert seen.samples == 0
    assert seen.colour.tolist() == [[1.0, 1.0, 1.0]]


def test_a_constant_slab_is_beer_lambert():
    # Closed form: opacity = 1 - exp(-sigma L) for sigma = 2 over the interpolated length L = 2.
    index = torch.arange(16**3, dtype=torch.int32).reshape(16, 16, 16)
    values = torch.zeros(16**3, 28)
    values[:, 0] = 2.0
    rays = Rays(
        torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([2.1]), torch.tensor([3.9])
    )
    field = BakedField(index, values, Sphere())
    shaded = shade_voxels(values, field.centres(), rays.origins[0])
    seen = render_voxels(VoxelGrid.of(index, Sphere()), shaded, rays, step=1.8 / 512)
    assert float(seen.opacity) == pytest.approx(1 - math.exp(-2 * 1.8), abs=1e-3)
    assert torch.allclose(seen.colour, (1 - seen.opacity)[:, None].expand(1, 3), atol=1e-5)  # black over white


def test_a_saved_baked_field_is_read_back(baked, tmp_path):
    baked.save(tmp_path / "ball.safetensors")
    again = BakedField.load(tmp_path / "ball.safetensors")
    assert torch.equal(again.index >= 0, baked.index >= 0)
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    directions = torch.nn.functional.normalize(points, dim=-1)
    for before, after in zip(baked(points, directions), again(points, directions), strict=True):
        assert torch.allclose(before, after, rtol=5e-3, atol=5e-3)
    assert again.bounds == baked.bounds


@pytest.mark.parametrize("unit", [1e-10, 1e-4, 1e10])
def test_a_saved_field_does_not_depend_on_the_unit_of_the_world(baked, tmp_path, unit):
    values = torch.cat([baked.values[:, :1] / unit, baked.values[:, 1:]], 1)
    BakedField(baked.index, values, Sphere(radius=unit)).save(tmp_path / "ball.safetensors")
    again = BakedField.load(tmp_path / "ball.safetensors")
    cameras = camera.pinhole(camera.symmetric_intrinsics(48, 48, 0.7), CAMERAS.extrinsics.clone(), 48, 48)
    cameras.extrinsics[:, :3, 3] *= unit
    expected, found = BakedScene(baked).render(CAMERAS), BakedScene(again).render(cameras)
    assert float(expected.opacity.max()) > 0.9
    torch.testing.assert_close(found.opacity, expected.opacity, atol=5e-3, rtol=0)
    assert float((found.images - expected.images).abs().mean()) < 2e-3
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    directions = torch.nn.functional.normalize(points, dim=-1)
    torch.testing.assert_close(again(points * unit, directions)[0], baked(points, directions)[0], atol=5e-3, rtol=0)


def test_a_file_that_is_not_a_baked_field_is_refused(tmp_path):
    from hyperplanes.utilities.files.checkpoints import save_tensors

    save_tensors(tmp_path / "other.safetensors", {"weights": torch.zeros(3)})
    with pytest.raises(
        CheckpointError, match=r"other\.safetensors: expected a baked field, .*\(weights\).*bake` writes"
    ):
        BakedField.load(tmp_path / "other.safetensors")
    save_tensors(tmp_path / "model.safetensors", {f"fine.{index}": torch.zeros(3) for index in range(50)})
    (tmp_path / "model.json").touch()
    with pytest.raises(CheckpointError, match=r"fine\.10, \.\.\.\); give the folder \S+ for a model$"):
        BakedField.load(tmp_path / "model.safetensors")
    (tmp_path / "cut.safetensors").write_bytes(b"\x10\x00")
    with pytest.raises(CheckpointError, match=r"cut\.safetensors"):
        BakedField.load(tmp_path / "cut.safetensors")


def test_wrong_arguments_are_refused(adapted):
    with pytest.raises(ValueError, match="side: expected a multiple of 2 from 8 to 512, got 15"):
        bake(adapted, side=15)
    with pytest.raises(ValueError, match="side: expected an even number of voxels an axis, got 3"):
        BakedField(torch.full((3, 3, 3), -1, dtype=torch.int32), torch.zeros(0, 28), Sphere()).save("never")
    empty = AdaptedField(lambda p, d: (torch.zeros_like(p), p.new_zeros(len(p))), full(Sphere(), 16), RayMarching())
    with pytest.raises(ValueError, match="empty everywhere"):
        bake(empty, side=16)


def test_distances_to_filled_cells():
    # Source of truth: a loop over the cells with the definition of the distance.
    index = torch.where(torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(0)) < 0.03, 0, -1)
    away = distance_to_filled(index)
    cells = [
        cell
        for cell in torch.cartesian_prod(*[torch.arange(7)] * 3)
        if any(
            (index[tuple(cell - step)] >= 0)
            for step in torch.cartesian_prod(*[torch.arange(2)] * 3)
            if ((cell - step >= 0) & (cell - step < 6)).all()
        )
    ]
    assert cells
    for cell in torch.cartesian_prod(*[torch.arange(7)] * 3):
        nearest = min(int((cell - filled).abs().max()) for filled in cells)
        assert int(away[tuple(cell)]) == nearest


def test_transmittance_of_a_slab_is_beer_lambert():
    # Closed form: exp(-optical depth of the voxels between a voxel and the border).
    optical_depth = torch.full((8, 8, 8), 0.3)
    cells = torch.tensor([[4, 4, 1], [4, 4, 7]])
    upward, downward = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]
    found = transmittance(optical_depth, cells, torch.tensor([upward, downward]))
    layers = torch.tensor([[1.0, 6.0], [7.0, 0.0]])
    torch.testing.assert_close(found, torch.exp(-0.3 * layers))


def test_transmittance_agrees_with_marching_in_pytorch():
    # Source of truth: the same marching in PyTorch, with all cells at once.
    generator = torch.Generator().manual_seed(0)
    optical_depth = torch.rand(12, 12, 12, generator=generator) * (torch.rand(12, 12, 12, generator=generator) < 0.3)
    cells, directions = torch.randint(0, 12, (50, 3), generator=generator), camera.fibonacci_sphere(9, 1.0)[:, 2, :3]
    total = torch.zeros(50, 9)
    for step in range(1, 22):  # the diagonal of the grid has 21 voxels
        here = (cells[:, None] + 0.5 - step * directions).floor().long()
        inside = ((here >= 0) & (here < 12)).all(-1)
        total += optical_depth[here.clamp(0, 11).unbind(-1)] * inside
    torch.testing.assert_close(transmittance(optical_depth, cells, directions), torch.exp(-total))


@pytest.mark.parametrize("side", [80, 96, 112, 128, 48])
def test_resampling_to_another_resolution_loses_no_region(side):
    occupied = torch.zeros(64, 64, 64, dtype=torch.bool)
    occupied[21:43, 21:43, 21:43] = True
    before = Occupancy(occupied, Sphere())
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    points = points[before.contains(points)]
    assert len(points) > 100
    assert _resampled(before, side).contains(points).all()


def test_nothing_outside_the_sphere_is_baked():
    """Rays end at the sphere, so that the field is not trained outside."""
    everywhere = AdaptedField(
        lambda points, _: (points * 0, points.new_full((len(points),), 9.0)), full(Sphere(), 16), RayMarching(32)
    )
    found = bake(everywhere, side=32)
    assert found.centres().norm(dim=1).max() < 1 + 2 * 2 / 32


def test_fitting_restores_colours_and_densities(coarse, seen, other_views):
    # Source of truth: pictures of the field from cameras that are not used for fitting.
    faded, steps = replace(coarse, values=0.9 * coarse.values), []
    fitted = fit_voxels(faded, Views(seen.images, CAMERAS), steps=30, pixels=1024, on_step=steps.append)
    assert quality_of(fitted, other_views) > quality_of(faded, other_views) + 5
    assert steps == list(range(1, 31))
    assert torch.equal(fitted.index, coarse.index)


def test_fitting_starts_with_voxels_of_bounded_optical_depth(coarse, seen, other_views, monkeypatch):
    """Voxels that are too dense: without the bound, opaque voxels occlude those behind them, which get no gradient."""
    opaque = replace(coarse, values=torch.cat([coarse.values[:, :1].clamp_min(300.0), coarse.values[:, 1:]], 1))
    found = []
    for bound in (voxel_fitting.LARGEST_DEPTH, math.inf):
        monkeypatch.setattr(voxel_fitting, "LARGEST_DEPTH", bound)
        fitted = fit_voxels(opaque, Views(seen.images, CAMERAS), steps=30, pixels=1024)
        found.append(quality_of(fitted, other_views))
    assert found[0] > found[1] + 1


def test_fitting_with_several_rays_per_edge_pixel_is_better_than_with_one(monkeypatch):
    """A ball with a hard surface, in pictures whose pixels are means over their areas, as in photographs."""
    ball = AdaptedField(
        lambda points, _: (points * 0, 500.0 * (points.norm(dim=-1) < 0.6)), full(Sphere(), 48), RayMarching(192)
    )
    whole, found = bake(ball, side=48), []
    shown, truth = (_means_of_areas(ball, count) for count in (6, 2))
    for edge in (voxel_fitting.EDGE_THRESHOLD, math.inf):
        monkeypatch.setattr(voxel_fitting, "EDGE_THRESHOLD", edge)
        fitted = fit_voxels(whole, shown, steps=40, pixels=1024)
        found.append(quality_of(fitted, truth))
    assert found[0] > found[1] + 1


def _means_of_areas(adapted, count):
    """Pictures of 24x24 pixels with 16 rays per pixel."""
    cameras = camera.pinhole(camera.symmetric_intrinsics(24, 24, 0.7), camera.fibonacci_sphere(count, 3.0), 24, 24)
    fine = adapted.render(camera.resized(cameras, 96, 96), antialias=False).images
    return Views(avg_pool2d(fine, 4), cameras)


def test_a_guide_preserves_parts_that_few_views_do_not_show(adapted, coarse, seen, other_views):
    """Two darker views: without the guide, PSNR of other views decreases; with it, it decreases less."""
    guide = render_guide(adapted, Views(seen.images, CAMERAS)[:2])
    assert guide is not None
    assert guide.size == (CAMERAS.height[0] // 2, CAMERAS.width[0] // 2)
    darker = Views(0.8 * seen.images, CAMERAS)[:2]
    alone, guided = (fit_voxels(coarse, darker, guide=each, steps=30, pixels=1024) for each in (None, guide))
    assert quality_of(guided, other_views) > quality_of(alone, other_views) + 3
    assert render_guide(adapted, other_views[[0, 1, 2] * 6]) is None


def test_the_guide_of_splats_is_rendered_from_voxels_in_the_size_of_the_views(adapted, seen, baked):
    """Source of truth: the field that the voxels were baked from, rendered from the same cameras."""
    few = Views(seen.images, CAMERAS)[:2]
    guide, wanted = (render_guide(source, few, size=few.size) for source in (BakedScene(baked), adapted))
    assert guide is not None
    assert guide.size == few.size
    assert len(guide) == 16
    assert float(psnr(guide.images, wanted.images).mean()) > 35


def test_rendering_ends_for_a_ray_that_is_nearly_parallel_to_an_axis(baked):
    """With a component of 1e-20, as in products of cosines, the number of steps would overflow."""
    rays = Rays(
        torch.tensor([[2.0, 0.0, -3.0]]), torch.tensor([[-1e-20, 0.0, 1.0]]), torch.tensor([2.0]), torch.tensor([4.0])
    )
    shaded, seen = shade_voxels(baked.values, baked.centres(), rays.origins[0]), []
    grid = VoxelGrid.of(baked.index, baked.bounds)
    worker = Thread(target=lambda: seen.append(render_voxels(grid, shaded, rays, step=0.01)), daemon=True)
    worker.start()
    worker.join(30)
    assert seen, "the renderer did not end"
    assert seen[0].opacity.tolist() == [0.0]
