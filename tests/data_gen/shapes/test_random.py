"""What random compositions promise. Sources of truth: trimesh's topology and volume, closed forms, statistics."""

from __future__ import annotations

import numpy as np
import pytest

from data_gen.shapes import assemble
from data_gen.shapes.profiles import ellipse, rectangle
from data_gen.shapes.random.outlines import AROUND, outline
from data_gen.shapes.random.primitives import FRAMES, PRIMITIVES
from data_gen.shapes.random.relief import displaced, vertex_normals
from data_gen.shapes.random.textures import TEXTURES
from data_gen.shapes.random.tubes import frames_along, moved, subdivided, tube


def check_solid(solid, where):
    mesh = solid.mesh()
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


def test_compositions_are_watertight_and_no_two_parts_have_one_name():
    for seed in range(40):
        parts = assemble("random", seed)
        assert len({part.name for part in parts}) == len(parts)
        for part in parts:
            check_solid(part.solid, (seed, part.name))


@pytest.mark.parametrize("make", PRIMITIVES, ids=lambda make: make.__name__)
def test_every_primitive_is_closed_right_way_out_and_fits_the_cube(make):
    for seed in range(12):
        for fine in (False, True) if make not in FRAMES else (False,):
            solid = make(np.random.default_rng(seed), fine)
            check_solid(solid, (seed, fine))
            assert np.abs(solid.vertices).max() < 2.0


def test_tubes_have_the_volumes_of_prisms_pyramids_and_rings():
    """Closed forms: base times height, a third of it, and Pappus' rule for a ring of many corners."""
    square = subdivided(rectangle(2.0, 2.0), AROUND)
    assert tube(upright(3.0, 5), np.tile(square, (5, 1, 1))).volume == pytest.approx(12)
    shrinking = np.linspace(1, 0, 5)[:, None, None] * square
    assert tube(upright(3.0, 5), shrinking).volume == pytest.approx(4)
    angles = np.arange(400) * (2 * np.pi / 400)
    circle = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    ring = tube(circle, np.tile(0.1 * ellipse(1, 1, 64), (400, 1, 1)), closed=True)
    assert ring.volume == pytest.approx(2 * np.pi**2 * 0.01, rel=0.01)
    check_solid(ring, "ring")


def test_frames_follow_a_curve_without_a_jump():
    """Property: rotations whose last column is the direction, and that of a closed curve ends as it begins."""
    angles = np.arange(60) * (2 * np.pi / 60)
    knot = np.stack([np.cos(angles), 0.4 * np.sin(2 * angles), np.sin(angles) + 0.3 * np.cos(3 * angles)], axis=1)
    frames = frames_along(knot, closed=True)
    np.testing.assert_allclose(frames.transpose(0, 2, 1) @ frames, np.tile(np.eye(3), (60, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames), 1)
    turns = np.einsum("kij,kij->k", frames, np.roll(frames, -1, axis=0))
    assert turns.min() > 2.7  # 1 + 2 cos of the angle between neighbours: less than 32 degrees
    np.testing.assert_allclose(frames_along(upright(1.0, 4))[2], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)


def test_a_height_field_moves_along_the_normal():
    """Closed form: a ball of many faces that is raised everywhere by a tenth has 1.331 times the volume."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 41)
    spine = np.stack([0 * angles, np.sin(angles), 0 * angles], axis=1)
    radii = np.cos(angles)
    radii[[0, -1]] = 0
    ball = tube(spine, radii[:, None, None] * ellipse(1, 1, 64))
    np.testing.assert_allclose(vertex_normals(ball), ball.vertices, atol=0.02)
    raised = displaced(ball, np.full(len(ball.vertices), 0.1))
    assert raised.volume == pytest.approx(1.331 * ball.volume, rel=0.002)
    check_solid(raised, "raised")


def test_a_reflection_keeps_a_solid_the_right_way_out():
    solid = next(iter(PRIMITIVES))(np.random.default_rng(0), True)
    flipped = moved(solid, np.diag([1.0, -0.5, 1.0]), np.array([3.0, 0.0, 0.0]))
    check_solid(flipped, "reflected")
    assert flipped.volume == pytest.approx(0.5 * solid.volume)


def test_outlines_are_simple_and_fill_their_square():
    """Brute force: seen from the mean of the corners, the angle to the next corner always grows."""
    for seed in range(80):
        corners, _ = outline(np.random.default_rng(seed))
        assert corners.shape == (AROUND, 2)
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
