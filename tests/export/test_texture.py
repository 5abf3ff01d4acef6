"""Source of truth: a ball with known colours, textured from support views, and pictures of its field."""

import json
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import grid_sample

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.export.surfaces import texture
from hyperplanes.export.surfaces.mesh import extract_mesh
from hyperplanes.export.surfaces.texture import save_textured, texture_surface
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.distortion import distorted
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere, cast, pixel_grid
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views

SIZE = 48


def striped(points, directions):
    """A hard ball with red stripes along one axis and green ones along another."""
    density = 300 * torch.sigmoid((0.7 - points.norm(dim=-1)) * 80)
    red, green = (torch.sigmoid(8 * torch.sin(5 * points[:, axis])) for axis in (0, 1))
    return torch.stack([red, green, torch.full_like(red, 0.3)], -1), density


@pytest.fixture(scope="module")
def field():
    return AdaptedField(striped, full(Sphere(), 24), RayMarching(160))


@pytest.fixture(scope="module")
def views(field):
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), camera.fibonacci_sphere(10, 3.0), SIZE, SIZE)
    seen = field.render(cameras)
    return Views(seen.images, cameras, seen.opacity)


def render_surface(mesh, cameras):
    """Pictures of a textured surface over white, with coverage, by intersecting four rays per pixel with triangles."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    height, width = camera.image_size(cameras)
    offsets = torch.tensor([-0.25, 0.25])
    pixels = (pixel_grid(height, width)[:, None] + torch.cartesian_prod(offsets, offsets)).reshape(-1, 2)
    texture = torch.from_numpy(mesh.texture).permute(2, 0, 1)[None].float() / 255
    pictures = []
    for view in range(cameras.batch_size):
        rays = cast(cameras, torch.full((len(pixels),), view), pixels)
        face, ray, place = solid.ray.intersects_id(
            rays.origins.numpy(), rays.directions.numpy(), multiple_hits=False, return_locations=True
        )
        shares = trimesh.triangles.points_to_barycentric(solid.triangles[face], place)
        at = torch.from_numpy((mesh.places[mesh.faces[face]] * shares[..., None]).sum(1)).float() * 2 - 1
        found = grid_sample(texture, at[None, None] * torch.tensor([1.0, -1.0]), align_corners=False)[0, :, 0].T
        values = torch.tensor([1.0, 1.0, 1.0, 0.0]).repeat(len(pixels), 1)
        values[torch.from_numpy(ray)] = torch.cat([found, torch.ones(len(found), 1)], 1)
        pictures.append(values.reshape(height, width, -1, 4).mean(2).permute(2, 0, 1))
    return torch.stack(pictures)


@pytest.fixture(scope="module")
def mesh(field, views):
    surface = extract_mesh(field, voxels=40, level=6.0)
    return texture_surface(surface, field, views, faces=1200, size=128)


def test_pictures_of_the_mesh_agree_with_the_field(mesh, field):
    around = camera.look_at(torch.tensor([[1.0, 2.0, 2.0], [-2.4, 0.6, -1.5]]), (0.0, 0.0, 0.0))
    cameras = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 0.7), around, SIZE, SIZE)
    truth, found = field.render(cameras), render_surface(mesh, cameras)
    covered, wanted = found[:, 3] > 0.5, truth.opacity[:, 0] > 0.5
    assert int((covered & wanted).sum()) / int((covered | wanted).sum()) > 0.97
    assert float(psnr(found[:, :3], truth.images).min()) > 24


def test_colours_come_from_the_views_that_see_the_surface(mesh, field, views):
    # If all views are blue, nearly all of the surface is blue, because nearly all of it is seen.
    blue = torch.zeros_like(views.images)
    blue[:, 2] = 1.0
    surface = extract_mesh(field, voxels=24, level=6.0)
    painted = texture_surface(surface, field, Views(blue, views.cameras), faces=400, size=64).texture
    assert float((painted[..., 2] > 230).mean()) > 0.95
    assert mesh.texture[..., 0].std() > 50


def test_the_weight_of_a_view_decreases_towards_a_border_that_cuts_the_object(field, monkeypatch):
    """A red view whose borders cut the ball, and a blue view from the same position that shows all of it."""
    eyes = camera.look_at(torch.tensor([[0.0, 0.0, 3.0]]), (0.0, 0.0, 0.0))
    near, far = (camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, a), eyes, SIZE, SIZE) for a in (0.25, 0.7))
    cameras = camera.concatenate([near, far])
    colours = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[:, :, None, None].expand(-1, -1, SIZE, SIZE)
    support = Views(colours.contiguous(), cameras, field.render(cameras).opacity)
    surface = extract_mesh(field, voxels=24, level=6.0)
    blue = replace(field, field=lambda p, d: (torch.tensor([[0.0, 0.0, 1.0]]).expand_as(p), striped(p, d)[1]))

    def share_between():
        red = texture_surface(surface, blue, support, faces=400, size=128).texture[..., 0] / 255.0
        assert red.max() > 0.45  # half red where both views see it
        return float(((red > 0.05) & (red < 0.4)).mean())

    smooth = share_between()
    monkeypatch.setattr(texture, "margins", lambda masks: torch.zeros(len(masks), 4))
    assert share_between() < smooth / 4


def test_a_view_whose_lens_does_not_show_a_texel_leaves_it_to_the_others(field):
    """Beyond the radius at which a barrel distortion turns back, a lens shows nothing: pixels are NaN there."""
    pinholes = camera.pinhole(camera.symmetric_intrinsics(SIZE, SIZE, 1.0), camera.fibonacci_sphere(8, 2.0), SIZE, SIZE)
    cameras = distorted(pinholes, torch.tensor([-4.0, 0.0, 0.0, 0.0, 0.0]))
    surface = extract_mesh(field, voxels=24, level=6.0)
    points = torch.from_numpy(np.array(surface.vertices, np.float32)).expand(8, -1, 3)
    assert cameras.project(points).isnan().any(-1).float().mean() > 0.1
    grey = Views(torch.full((8, 3, SIZE, SIZE), 0.5), cameras)
    painted = texture_surface(surface, field, grey, faces=400, size=64).texture
    assert float((painted.astype(int).max(-1) < 20).mean()) < 0.01


def test_the_file_has_normals_a_texture_and_an_unlit_material(mesh, tmp_path):
    # Sources of truth: trimesh's reader, and the JSON chunk of the file as defined by glTF 2.0.
    with pytest.raises(ValueError, match="expected a name that ends in glb, got 'ply'"):
        save_textured(mesh, tmp_path / "ball.ply")
    path = save_textured(mesh, tmp_path / "ball.glb")
    loaded = next(iter(trimesh.load_scene(path).geometry.values()))
    assert np.allclose(loaded.vertices, mesh.vertices, atol=1e-5)
    assert np.allclose(loaded.visual.uv, mesh.places, atol=1e-5)
    assert np.array(loaded.visual.material.baseColorTexture.convert("RGB")).shape == mesh.texture.shape
    content = path.read_bytes()
    tree = json.loads(content[20 : 20 + struct.unpack("<I", content[12:16])[0]])
    material = tree["materials"][0]
    assert "KHR_materials_unlit" in material["extensions"]
    assert "KHR_materials_unlit" in tree["extensionsUsed"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert "NORMAL" in tree["meshes"][0]["primitives"][0]["attributes"]
    outward = (mesh.normals * mesh.vertices).sum(1) / np.linalg.norm(mesh.vertices, axis=1)
    assert outward.min() > math.cos(math.radians(30))


def test_the_texture_does_not_depend_on_the_unit_of_the_world():
    ball = trimesh.creation.icosphere(4)
    faces = np.array(ball.faces, np.uint32)
    for unit in (1.0, 1e-3):
        vertices = np.array(unit * (ball.vertices + 5), np.float32)
        _, indices, places, height, width = texture._unwrapped(vertices, faces, 256)
        assert min(height, width) > 150
        assert np.isfinite(places[indices]).all()
        (a, b), (c, d) = (np.moveaxis(places[indices[:, n]] - places[indices[:, 0]], 1, 0) for n in (1, 2))
        assert (np.abs(a * d - b * c) > 0).mean() > 0.99
