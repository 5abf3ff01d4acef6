"""Properties of random compositions. Sources of truth: trimesh's topology and volume, closed forms, statistics."""

from __future__ import annotations

import numpy as np
import pytest
from solid_checks import bare_mesh

from data_gen.shapes import assemble, make
from data_gen.shapes.materials import plain
from data_gen.shapes.parts import Finish, Part, build_scene
from data_gen.shapes.primitives import box
from data_gen.shapes.profiles import ellipse, rectangle
from data_gen.shapes.random.cuts import CUT_FACE, difference
from data_gen.shapes.random.outlines import OUTLINE_CORNERS, outline
from data_gen.shapes.random.painting.marks import glyph
from data_gen.shapes.random.painting.photographs import PHOTOGRAPHS
from data_gen.shapes.random.painting.textures import TEXTURES
from data_gen.shapes.random.primitives import BAR_PRIMITIVES, PRIMITIVES, primitive
from data_gen.shapes.random.relief import displaced, vertex_normals
from data_gen.shapes.random.structures import STRUCTURES
from data_gen.shapes.random.tubes import frames_along, subdivided, tube


def check_solid(solid, where):
    mesh = bare_mesh(solid)
    assert np.isfinite(solid.vertices).all(), where
    assert mesh.is_watertight, where
    assert mesh.is_winding_consistent, where
    assert solid.volume > 0, where
    assert mesh.volume == pytest.approx(solid.volume, rel=1e-6), where
    assert solid.uv.shape == (len(solid.faces), 3, 2), where
    assert solid.uv.min() >= 0, where
    assert solid.uv.max() <= 1, where


def upright(height, stations):
    return np.stack([np.zeros(stations), np.linspace(0, height, stations), np.zeros(stations)], axis=1)


def test_compositions_are_watertight_and_names_of_parts_are_unique():
    for seed in range(12):
        parts = assemble("random", seed)
        assert len({part.name for part in parts}) == len(parts)
        for part in parts:
            check_solid(part.solid, (seed, part.name))


@pytest.mark.parametrize("make", PRIMITIVES, ids=lambda make: make.__name__)
def test_every_primitive_is_closed_oriented_outwards_and_fits_the_cube(make):
    for seed in range(4):
        for fine in (False, True) if make not in BAR_PRIMITIVES else (False,):
            solid = make(np.random.default_rng(seed), fine)
            check_solid(solid, (seed, fine))
            assert np.abs(solid.vertices).max() < 2.0


@pytest.mark.parametrize("make", STRUCTURES, ids=lambda make: make.__name__)
def test_every_structure_has_closed_solids(make):
    for seed in range(3):
        solids = make(np.random.default_rng(seed))
        assert len(solids) > 1
        for number, solid in enumerate(solids):
            check_solid(solid, (seed, number))


def test_a_cut_keeps_the_texture_of_old_faces_and_names_new_ones():
    """Closed form: a quarter is cut off a cube. Only the new faces are in the cutting planes."""
    cube, tool = box(2, 2, 2), box(2, 2, 3).moved(1, 1)
    left = difference(cube, tool)
    check_solid(left, "cut")
    assert left.volume == pytest.approx(6)
    new = left.cells[:, 0] == CUT_FACE
    corners = left.vertices[left.faces]
    flat = (np.abs(corners[..., :2]) < 1e-12).all(axis=1).any(axis=1)
    np.testing.assert_array_equal(new, flat)
    front = ~new & (corners[..., 2] > 1 - 1e-9).all(axis=1)
    whole = (cube.vertices[cube.faces][..., 2] > 1 - 1e-9).all(axis=1)
    affine = np.linalg.lstsq(
        np.c_[cube.vertices[cube.faces][whole][:, :, :2].reshape(-1, 2), np.ones(6)], cube.uv[whole].reshape(-1, 2)
    )[0]
    expected = np.c_[corners[front][..., :2].reshape(-1, 2), np.ones(3 * front.sum())] @ affine
    np.testing.assert_allclose(left.uv[front].reshape(-1, 2), expected, atol=1e-9)
    assert difference(cube, box(3, 3, 3)) is None


def test_cuts_of_random_solids_stay_closed():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        solid, tool = primitive(rng, 0.5), primitive(rng, 0.5)
        left = difference(solid, tool.transformed(0.6 * np.eye(3), rng.uniform(-0.6, 0.6, 3)))
        if left is not None:
            check_solid(left, seed)
            assert left.volume <= solid.volume * (1 + 1e-9)


def test_the_same_seed_gives_the_same_vertices_and_pixels():
    def arrays(seed):
        for mesh in make("random", seed).geometry.values():
            yield from (mesh.vertices, mesh.faces, mesh.vertex_normals, mesh.visual.uv)
            yield np.asarray(mesh.visual.material.baseColorTexture)

    for seed in range(3):
        for one, other in zip(arrays(seed), arrays(seed), strict=True):
            np.testing.assert_array_equal(one, other)


def test_parts_with_two_materials_are_two_geometries_with_one_texture():
    matt = Part.of("matt", box(1, 1, 1), plain((200, 20, 20)))
    glossy = Part("glossy", box(1, 1, 1).moved(2), (plain((20, 20, 200)),), np.zeros(12, np.int64), Finish(0.35, 0.3))
    scene = build_scene("thing", [matt, glossy, Part.of("other", box(1, 1, 1).moved(4), plain((1, 2, 3)))])
    assert list(scene.geometry) == ["thing", "thing_1"]
    first, second = (mesh.visual.material for mesh in scene.geometry.values())
    assert first.baseColorTexture is second.baseColorTexture
    assert (first.roughnessFactor, first.metallicFactor) == (0.55, 0.0)
    assert (second.roughnessFactor, second.metallicFactor) == (0.35, 0.3)
    assert [name for name, _, _ in scene.geometry["thing"].metadata["parts"]] == ["matt", "other"]
    assert (scene.geometry["thing_1"].visual.to_color().vertex_colors[:, :3] == (20, 20, 200)).all()


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_photographs_have_a_free_licence_by_their_documentation(name):
    """Source of truth: scikit-image's docstrings, which state the licence of each picture."""
    import skimage.data

    text = " ".join((getattr(skimage.data, name).__doc__ or "").split())
    assert "CC0" in text or "Creative Commons CC0" in text or "public domain" in text.lower()


def test_glyphs_are_connected():
    """Brute force: all pixels of a glyph are connected through their sides."""
    from scipy.ndimage import label

    for seed in range(50):
        assert label(glyph(np.random.default_rng(seed)))[1] == 1


def test_tubes_have_the_volumes_of_prisms_pyramids_and_rings():
    """Closed forms: base times height, a third of it, and Pappus' theorem for a ring of many corners."""
    square = subdivided(rectangle(2.0, 2.0), OUTLINE_CORNERS)
    assert tube(upright(3.0, 5), np.tile(square, (5, 1, 1))).volume == pytest.approx(12)
    shrinking = np.linspace(1, 0, 5)[:, None, None] * square
    assert tube(upright(3.0, 5), shrinking).volume == pytest.approx(4)
    angles = np.arange(400) * (2 * np.pi / 400)
    circle = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    ring = tube(circle, np.tile(0.1 * ellipse(1, 1, 64), (400, 1, 1)), closed=True)
    assert ring.volume == pytest.approx(2 * np.pi**2 * 0.01, rel=0.01)
    check_solid(ring, "ring")


def test_frames_along_a_curve_are_continuous():
    """Property: frames are rotations with the direction as last column; on closed curves, the last equals the first."""
    angles = np.arange(60) * (2 * np.pi / 60)
    knot = np.stack([np.cos(angles), 0.4 * np.sin(2 * angles), np.sin(angles) + 0.3 * np.cos(3 * angles)], axis=1)
    frames = frames_along(knot, closed=True)
    np.testing.assert_allclose(frames.transpose(0, 2, 1) @ frames, np.tile(np.eye(3), (60, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1)
    turns = np.einsum("kij,kij->k", frames, np.roll(frames, -1, axis=0))
    assert turns.min() > 2.7  # 1 + 2 cos of the angle between neighbours: less than 32 degrees
    np.testing.assert_allclose(frames_along(upright(1.0, 4))[2], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)


def test_a_height_field_moves_along_the_normal():
    """Closed form: a ball of many faces that is raised by a tenth everywhere has 1.331 times the volume."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 41)
    spine = np.stack([0 * angles, np.sin(angles), 0 * angles], axis=1)
    radii = np.cos(angles)
    radii[[0, -1]] = 0
    ball = tube(spine, radii[:, None, None] * ellipse(1, 1, 64))
    np.testing.assert_allclose(vertex_normals(ball), ball.vertices, atol=0.02)
    raised = displaced(ball, np.full(len(ball.vertices), 0.1))
    assert raised.volume == pytest.approx(1.331 * ball.volume, rel=0.002)
    check_solid(raised, "raised")


def test_a_reflected_solid_is_oriented_outwards():
    solid = next(iter(PRIMITIVES))(np.random.default_rng(0), True)
    flipped = solid.transformed(np.diag([1.0, -0.5, 1.0]), np.array([3.0, 0.0, 0.0]))
    check_solid(flipped, "reflected")
    assert flipped.volume == pytest.approx(0.5 * solid.volume)


def test_outlines_do_not_intersect_themselves_and_fill_their_square():
    """Brute force: from the mean of the corners, the angle always increases to the next corner."""
    for seed in range(80):
        corners, _ = outline(np.random.default_rng(seed))
        assert corners.shape == (OUTLINE_CORNERS, 2)
        assert np.abs(corners).max() == pytest.approx(1)
        around = corners - corners.mean(axis=0)
        following = np.roll(around, -1, axis=0)
        cross = around[:, 0] * following[:, 1] - around[:, 1] * following[:, 0]
        assert (cross > -1e-9).all(), seed


@pytest.mark.parametrize("make", TEXTURES, ids=lambda make: make.__name__)
def test_textures_are_small_pictures_and_differ(make):
    images = [make(np.random.default_rng(seed)).image for seed in range(4)]
    for image in images:
        assert image.dtype == np.uint8
        assert image.shape[2] == 3
        assert max(image.shape) <= 240
    assert len({image.tobytes() for image in images}) == 4
