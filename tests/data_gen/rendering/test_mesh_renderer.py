"""Source of truth: closed forms of pictures of simple shapes, for each renderer that works, and other renderers.

A process can use only one OpenGL platform. If that is EGL, OSMesa runs in a subprocess.
"""

import os
import subprocess
import sys
import threading
from dataclasses import replace

import drawn_parts
import numpy as np
import pytest
import torch
import trimesh
from drawn_parts import draw_tricky, placed, sheet
from PIL import Image

from data_gen import rigs
from data_gen.meshes.mesh import mesh_parts, prepare_scene
from data_gen.rendering.lighting import Lighting
from data_gen.rendering.mesh_renderer import RENDER_CHANNELS, MeshRenderer, RenderError
from data_gen.rendering.renderers import RENDERERS, RendererError, probe
from data_gen.rendering.surfaces import shaded_surfaces
from data_gen.shapes import ONE_SIDED, make

DARK = Lighting((), sky=(0.0,) * 3, ground=(0.0,) * 3)
HERE = [name for name in RENDERERS if name != "pyrender-osmesa"]


def _skip_unless_working(name):
    outcome = probe(name)
    if not outcome.works:
        pytest.skip(f"{name} does not work here: {outcome.message}")


@pytest.fixture(params=HERE)
def backend(request):
    _skip_unless_working(request.param)
    return request.param


def _closest(mesh, points):
    """The nearest face of each ray and its distance, by brute force."""
    count = len(mesh.faces)
    nearest = trimesh.triangles.closest_point(
        np.tile(mesh.triangles, (len(points), 1, 1)), np.repeat(points, count, axis=0)
    )
    distances = np.linalg.norm(nearest.reshape(-1, count, 3) - points[:, None], axis=-1)
    return distances.argmin(axis=1), distances.min(axis=1)


def _emissive(mesh, colour=(255, 255, 255)):
    """The mesh with emission only, so that its colour is constant and only coverage matters."""
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[0, 0, 0, 255], emissiveFactor=[c / 255 for c in colour], metallicFactor=0.0
    )
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=material)
    return mesh


def _front_rig(resolution, distance=3.0):
    return rigs.orbit(1, resolution, elevation=0.0, distance=distance)


def _kornia_pixels(rig, points):
    """Pixels (view, point, 2) of points, by Kornia's camera."""
    return rig.cameras().project(torch.from_numpy(np.tile(points, (len(rig), 1, 1)))).numpy()


def _over_white(rgba):
    alpha = rgba[..., 3:] / 255.0
    return rgba[..., :3] * alpha + 255.0 * (1.0 - alpha)


@pytest.mark.parametrize("rig", [rigs.fixed(5, 64), replace(rigs.fixed(5, 120), width=200)])
def test_spheres_are_at_the_pixels_of_kornias_projection(backend, rig):
    # The centroid of a small sphere's image differs from the projection of its centre by O(radius^2).
    centres = np.array([[0.0, 0.0, 0.0], [0.5, 0.3, -0.2], [-0.4, -0.5, 0.4], [0.1, 0.6, 0.5]])
    expected = _kornia_pixels(rig, centres)
    renderer = MeshRenderer(backend, supersample=8)
    for number, centre in enumerate(centres):
        ball = _emissive(trimesh.creation.icosphere(3, radius=0.08))
        alpha = renderer.render([placed(ball, trimesh.transformations.translation_matrix(centre))], rig).rgba[..., 3]
        weights = alpha / alpha.sum(axis=(1, 2), keepdims=True, dtype=float)
        x = (weights * np.arange(rig.width)).sum(axis=(1, 2))
        y = (weights * np.arange(rig.height)[:, None]).sum(axis=(1, 2))
        np.testing.assert_allclose(np.stack((x, y), axis=-1), expected[:, number], atol=0.05)


def test_alpha_is_the_covered_area_of_the_pixel(backend):
    # A square with an image from u0 to u1 covers the overlap of [u0, u1] and [i - 1/2, i + 1/2] of pixel i.
    rig = _front_rig(48)
    size = 0.613
    (u0, v1), (u1, v0) = _kornia_pixels(rig, np.array([[-size, -size, 0.0], [size, size, 0.0]]))[0]
    pixel = np.arange(48)
    across = np.clip(np.minimum(u1, pixel + 0.5) - np.maximum(u0, pixel - 0.5), 0.0, 1.0)
    down = np.clip(np.minimum(v1, pixel + 0.5) - np.maximum(v0, pixel - 0.5), 0.0, 1.0)
    for supersample in (1, 3, 8):
        alpha = MeshRenderer(backend, supersample=supersample).render([sheet(size)], rig).rgba[0, ..., 3] / 255.0
        # Samples have distances of 1 / supersample, so that an edge is wrong by at most half of that.
        np.testing.assert_allclose(alpha, down[:, None] * across, atol=1.01 / supersample / 2 + 0.004)


def test_sphere_silhouette_has_the_area_of_its_cone(backend):
    rig = _front_rig(100)
    ball = trimesh.creation.icosphere(5, radius=0.8)
    alpha = MeshRenderer(backend, supersample=4).render([ball], rig).rgba[0, ..., 3] / 255.0
    radius = rig.intrinsics[0, 0, 0] * np.tan(np.arcsin(0.8 / 3.0))
    # A tolerance of 0.05 pixels of the radius, since icospheres are inscribed.
    assert abs(np.sqrt(alpha.sum() / np.pi) - radius) < 0.05
    # With 4 x 4 samples, alpha has many multiples of 1/16.
    np.testing.assert_allclose(alpha * 16, np.rint(alpha * 16), atol=16 / 510 + 1e-9)
    assert len(np.unique(alpha)) > 12


def test_no_dark_fringe_over_white(backend):
    # Each pixel of an emissive off-white sphere over white, also at edges, is between the two colours.
    ball = _emissive(trimesh.creation.icosphere(4, radius=0.8), (240, 240, 240))
    rgba = MeshRenderer(backend).render([ball], rigs.fixed(2, 64), lighting=DARK).rgba
    inside = rgba[rgba[..., 3] == 255]
    flat = inside[0, 0]
    assert (inside[:, :3] == flat).all()
    partial = rgba[(rgba[..., 3] > 0) & (rgba[..., 3] < 255)]
    assert len(partial) > 100
    np.testing.assert_allclose(partial[:, :3], flat, atol=1)
    assert _over_white(rgba).min() >= flat - 1
    assert not rgba[rgba[..., 3] == 0].any()


def _assert_agree(one, other):
    """Silhouettes agree to half a pixel, and colours to 1 of 255 on average and to 4 for 99 % of pixels."""
    a, b = one.astype(float), other.astype(float)
    # An edge with an error of half a pixel changes alpha by 1/2.
    assert np.abs(a[..., 3] - b[..., 3]).max() < 128
    # The area changes much less.
    np.testing.assert_allclose(a[..., 3].sum(axis=(1, 2)), b[..., 3].sum(axis=(1, 2)), rtol=2e-3)
    difference = np.abs(_over_white(a) - _over_white(b)).max(axis=-1)[a[..., 3] > 0]
    assert difference.mean() < 1.0
    assert np.quantile(difference, 0.99) < 4.0


@pytest.fixture(scope="module")
def tricky_by_embree():
    return draw_tricky("embree")


def test_egl_and_embree_agree(tricky_by_embree):
    _skip_unless_working("pyrender-egl")
    _assert_agree(draw_tricky("pyrender-egl"), tricky_by_embree)


def _drawn_elsewhere(path, *names):
    """The tricky parts drawn in another process, by name of the renderer."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run([sys.executable, drawn_parts.__file__, str(path), *names], check=True, env=environment)
    return np.load(path)


@pytest.fixture(scope="module")
def drawn_elsewhere(tmp_path_factory):
    names = [name for name in HERE if probe(name).works]
    return _drawn_elsewhere(tmp_path_factory.mktemp("drawn") / "again.npz", *names)


def test_osmesa_and_embree_agree(tricky_by_embree, tmp_path):
    _skip_unless_working("pyrender-osmesa")
    drawn = _drawn_elsewhere(tmp_path / "drawn.npz", "pyrender-osmesa")
    _assert_agree(drawn["pyrender-osmesa"], tricky_by_embree)


def test_same_bytes_in_every_run_and_process(backend, drawn_elsewhere):
    first = draw_tricky(backend)
    MeshRenderer(backend).render([sheet()], replace(_front_rig(17), width=31))
    assert np.array_equal(first, draw_tricky(backend))
    assert np.array_equal(first, drawn_elsewhere[backend])


def test_reversed_faces_look_like_any_others(backend):
    ball = trimesh.creation.icosphere(3, radius=0.7)
    inside_out = ball.copy()
    inside_out.invert()
    renderer = MeshRenderer(backend)
    right = renderer.render([ball], rigs.fixed(2, 48)).rgba
    wrong = renderer.render([inside_out], rigs.fixed(2, 48)).rgba
    assert np.abs(right.astype(int) - wrong).max() <= 2


@pytest.mark.parametrize("class_name", ONE_SIDED)
def test_inner_sides_of_generated_objects_are_not_visible(class_name):
    """Property: without their inner sides, closed objects cover the same samples and have the same picture.

    But for a sample here and there on an outline itself, where both sides have one depth.
    """
    _skip_unless_working("pyrender-egl")
    renderer, rig = MeshRenderer("pyrender-egl"), rigs.fixed(6, 64)
    for seed in range(4):
        whole, outer = (
            renderer.render(mesh_parts(prepare_scene(make(class_name, seed), "it", closed=closed)), rig).rgba
            for closed in (False, True)
        )
        assert np.array_equal(whole[..., 3], outer[..., 3])
        assert (whole != outer).any(axis=-1).sum() < 0.002 * (whole[..., 3] > 0).sum()


def test_a_sheet_is_visible_from_both_sides(backend):
    rig = rigs.orbit(2, 32, elevation=0.0)
    rgba = MeshRenderer(backend).render([sheet()], rig).rgba
    assert (rgba[:, 16, 16, 3] == 255).all()
    assert rgba[:, 16, 16, :3].min() > 60


def test_glass_over_black_and_white_closed_form(backend):
    # Emissive glass of alpha 0.4 before an emissive wall gives 0.4 glass + 0.6 wall and alpha 1; alone, alpha 0.4.
    glass, wall = _emissive(sheet(0.9), (255, 0, 0)), _emissive(sheet(0.5), (0, 0, 255))
    glass.visual.material.baseColorFactor = [0, 0, 0, 102]
    glass.visual.material.alphaMode = "BLEND"
    behind = trimesh.transformations.translation_matrix([0, 0, -0.5])
    rgba = MeshRenderer(backend).render([glass, placed(wall, behind)], _front_rig(33), lighting=DARK).rgba[0]
    np.testing.assert_allclose(rgba[16, 16], [102, 0, 153, 255], atol=2)
    np.testing.assert_allclose(rgba[16, 5], [255, 0, 0, 102], atol=2)


@pytest.mark.parametrize("first", [-0.3, 0.3])
def test_of_the_translucent_faces_of_a_surface_the_nearer_is_in_front(backend, first):
    # Red glass of alpha 1/2 on one side and blue glass on the other, in any order of the file: the nearer one
    # contributes 2/3 of the colour of both.
    panes = trimesh.util.concatenate([sheet(0.9, uv=False), sheet(0.9, uv=False)])
    panes.vertices[:4, 2], panes.vertices[4:, 2] = first, -first
    red, blue = [255, 0, 0, 128], [0, 0, 255, 128]
    colours = [red, red, blue, blue] if first > 0 else [blue, blue, red, red]
    panes.visual = trimesh.visual.ColorVisuals(panes, face_colors=colours)
    flat, rig = Lighting((), sky=(0.7,) * 3, ground=(0.7,) * 3), rigs.orbit(2, 33, elevation=0.0)
    front, back = MeshRenderer(backend).render([panes], rig, lighting=flat).rgba[:, 16, 16].astype(int)
    assert front[0] / (front[0] + front[2]) == pytest.approx(2 / 3, abs=0.02)
    np.testing.assert_allclose(back, front[[2, 1, 0, 3]], atol=1)


def test_transparent_texels_do_not_bleed(backend):
    # Green leaves on transparent black: all visible pixels are as green as the leaf.
    texels = np.zeros((64, 64, 4), np.uint8)
    texels[::8, :, :] = texels[1::8] = texels[2::8] = (40, 220, 40, 255)
    square = sheet(0.9)
    square.visual.material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(texels))
    flat = Lighting((), sky=(0.7,) * 3, ground=(0.7,) * 3)
    rgba = MeshRenderer(backend).render([square], _front_rig(40), lighting=flat).rgba[0]
    seen = rgba[rgba[..., 3] > 40].astype(int)
    assert len(seen) > 100
    assert (seen[:, 1] > seen[:, 1].max() - 12).all()


@pytest.mark.parametrize("alpha_mode", ["MASK", "BLEND"])
def test_objects_behind_many_transparent_sheets_are_visible(backend, alpha_mode):
    # As in foliage, any number of transparent texels in front of the wall adds nothing.
    clear = sheet(0.9)
    texels = np.zeros((4, 4, 4), np.uint8)
    texels[0, 0] = 255
    clear.visual.material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(texels), alphaMode=alpha_mode
    )
    place = trimesh.transformations.translation_matrix
    sheets = [placed(clear, place([0, 0, 0.02 * number])) for number in range(30)]
    rig, back = _front_rig(9), placed(sheet(0.9), place([0, 0, -0.5]))
    renderer = MeshRenderer(backend)
    alone = renderer.render([back], rig, channels=("rgba", "depth"))
    behind = renderer.render([*sheets, back], rig, channels=("rgba", "depth"))
    np.testing.assert_allclose(behind.rgba[0, 4, 4], alone.rgba[0, 4, 4], atol=1)
    assert behind.depth[0, 4, 4] == alone.depth[0, 4, 4]


def test_texture_is_the_right_way_up(backend):
    quarters = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
    square = sheet(0.9)
    square.visual.material = trimesh.visual.material.SimpleMaterial(
        image=Image.fromarray(quarters).resize((64, 64), Image.Resampling.NEAREST)
    )
    rgb = MeshRenderer(backend).render([square], _front_rig(40)).rgba[0, ..., :3]
    bright = rgb > 100
    assert bright[12, 12].tolist() == [True, False, False]
    assert bright[12, 28].tolist() == [False, True, False]
    assert bright[28, 12].tolist() == [False, False, True]
    assert bright[28, 28].tolist() == [True, True, False]


@pytest.mark.parametrize("kind", ["vertex", "face", "texture", "kd"])
@pytest.mark.parametrize("colour", [(180, 90, 60), (16, 17, 30)])
def test_srgb_colours_are_drawn_alike_for_every_way_to_give_them(backend, kind, colour):
    square = sheet(0.9)
    if kind == "texture":
        square.visual.material = trimesh.visual.material.SimpleMaterial(image=Image.new("RGB", (4, 4), colour))
    elif kind == "kd":
        square.visual.material = trimesh.visual.material.SimpleMaterial(diffuse=[*colour, 255])
    else:
        colours = np.tile([*colour, 255], (4 if kind == "vertex" else 2, 1)).astype(np.uint8)
        square.visual = trimesh.visual.ColorVisuals(square, **{f"{kind}_colors": colours})
    # Ambient light of 0.8 on a diffuse surface: linear(colour) x 0.8.
    flat = Lighting((), sky=(0.8,) * 3, ground=(0.8,) * 3)
    expected = 255 * (0.8 * ((np.array(colour) / 255 + 0.055) / 1.055) ** 2.4)
    expected = 255 * (1.055 * (expected / 255) ** (1 / 2.4) - 0.055)
    rgba = MeshRenderer(backend).render([square], _front_rig(16), lighting=flat).rgba[0, 8, 8]
    np.testing.assert_allclose(rgba, [*expected, 255], atol=1.5)


def test_geometry_is_on_the_mesh_to_a_hundredth_of_a_pixel():
    pose = trimesh.transformations.translation_matrix([0.1, -0.2, 0.3]) @ np.diag([1.0, 1.3, 0.7, 1.0])
    mesh = placed(trimesh.creation.icosphere(2, radius=0.6), pose)
    mesh.metadata["smooth"] = False
    rig = replace(rigs.fixed(3, 40), width=50)
    out = MeshRenderer("embree", supersample=1).render([mesh], rig, channels=RENDER_CHANNELS)
    x, y = np.meshgrid(np.arange(50), np.arange(40))
    rays = np.stack((x, y, np.ones_like(x)), axis=-1) @ np.linalg.inv(rig.intrinsics[0]).T
    for view, world_from_camera in enumerate(rig.world_from_camera):
        depth = out.depth[view]
        mask = depth > 0
        points = (rays * depth[..., None])[mask] @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        footprint = depth[mask].max() / rig.intrinsics[0, 0, 0]
        face, distance = _closest(mesh, points)
        assert distance.max() < 0.01 * footprint
        np.testing.assert_allclose(out.coordinates[view][mask], points, atol=1e-5)
        normals = out.normals[view][mask]
        aligned = np.abs(np.einsum("pi,pi->p", normals, mesh.face_normals[face]))
        assert np.quantile(aligned, 0.02) > 0.999
        towards = world_from_camera[:3, 3] - points
        assert (np.einsum("pi,pi->p", normals, towards) > 0).all()
        assert not out.coordinates[view][~mask].any()
        # With one sample per pixel, colour and geometry have the same coverage.
        assert np.array_equal(mask, out.rgba[view, ..., 3] > 0)


def test_geometry_ignores_mostly_transparent_surfaces():
    glass = _emissive(sheet(0.9))
    glass.visual.material.alphaMode = "BLEND"
    wall, behind = sheet(0.9), trimesh.transformations.translation_matrix([0, 0, -0.5])
    for alpha, depth in ((100, 3.5), (200, 3.0)):
        glass.visual.material.baseColorFactor = [0, 0, 0, alpha]
        out = MeshRenderer("embree").render([glass, placed(wall, behind)], _front_rig(9), channels=("depth",))
        assert out.rgba is None
        np.testing.assert_allclose(out.depth[0, 4, 4], depth, atol=1e-6)


def test_invisible_and_invalid_objects_are_named(backend):
    away = trimesh.transformations.translation_matrix([50.0, 0, 0])
    empty = trimesh.Trimesh()
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    untextured = sheet(uv=False)
    untextured.visual = trimesh.visual.TextureVisuals(image=Image.new("RGB", (2, 2)))
    several = sheet()
    several.visual.material = trimesh.visual.material.MultiMaterial()
    rig = _front_rig(8)
    renderer = MeshRenderer(backend)
    for parts, message in (
        ([placed(sheet(), away)], "teapot: expected some of it to be visible in 1 views"),
        ([], "teapot: expected at least one face, got 0 parts"),
        ([empty], "teapot: expected at least one face, got 1 parts"),
        ([broken], "teapot, part 0: expected finite vertices, got 1 faces"),
        ([several], "part 0: expected a PBRMaterial or a SimpleMaterial, got MultiMaterial"),
        ([untextured], "texture coordinates for its 4 textured vertices, got none"),
    ):
        with pytest.raises(RenderError, match=message):
            renderer.render(parts, rig, name="teapot")
    assert renderer.render([sheet()], rig).rgba.any()


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="expected 1 to 8, got 9"):
        MeshRenderer("embree", supersample=9)
    with pytest.raises(ValueError, match="got 'vulkan'"):
        MeshRenderer("vulkan")
    with pytest.raises(ValueError, match="rgba, depth, normals, coordinates, got rgb"):
        MeshRenderer("embree").render([sheet()], _front_rig(8), channels=("rgb",))


def test_rasterisers_share_the_context_and_other_threads_are_refused():
    _skip_unless_working("pyrender-egl")
    parts, rig = [sheet()], _front_rig(8)
    caught = []

    def elsewhere():
        try:
            MeshRenderer("pyrender-egl")
        except RendererError as error:
            caught.append(str(error))

    outer = MeshRenderer("pyrender-egl")
    assert MeshRenderer("pyrender-egl").render(parts, rig).rgba.any()
    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert outer.render(parts, rig).rgba.any()
    assert "spawn" in caught[0]
    with pytest.raises(RendererError, match="pyrender-egl, which this process uses, got pyrender-osmesa"):
        MeshRenderer("pyrender-osmesa")


def test_the_error_of_a_renderer_that_cannot_start_has_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(RendererError, match="'embree': expected it to start, found .*Remedy: pip install embreex"):
        MeshRenderer("embree")


def test_unreferenced_invalid_vertices_and_zero_normals_are_harmless():
    corners = [[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [np.nan, 0, 0]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2]], vertex_normals=np.zeros((4, 3)), process=False, validate=False)
    out = MeshRenderer("embree").render([mesh], _front_rig(9), channels=("rgba", "normals"))
    assert out.rgba[0, 4, 4, :3].min() > 80
    np.testing.assert_allclose(out.normals[0, 4, 4], [0, 0, 1], atol=1e-6)


def test_metal_is_not_black_and_the_default_is_not_metallic():
    def shade(**material):
        square = sheet(0.9)
        square.visual.material = trimesh.visual.material.PBRMaterial(baseColorFactor=[128, 128, 128, 255], **material)
        return int(MeshRenderer("embree").render([square], _front_rig(8)).rgba[0, 4, 4, 0])

    assert shade() == shade(metallicFactor=0.0)
    assert shade(metallicFactor=1.0) > 0.8 * shade()


def test_equal_textures_of_parts_share_their_texels():
    def part():
        square = sheet()
        square.visual.material = trimesh.visual.material.SimpleMaterial(image=Image.new("RGB", (4, 4), (9, 8, 7)))
        return square

    one, other = shaded_surfaces([part(), part()])
    assert one.texture is other.texture
