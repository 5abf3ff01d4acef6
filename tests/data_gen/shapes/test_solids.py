"""Sources of truth: closed forms of volumes, trimesh's volume and topology checks, and the shoelace formula."""

from __future__ import annotations

import numpy as np
import pytest
from solid_checks import bare_mesh

from data_gen.shapes import primitives as make
from data_gen.shapes.profiles import (
    airfoil,
    ellipse,
    polygon_area,
    rectangle,
    rounded_rectangle,
    superellipse,
    triangulate,
)
from data_gen.shapes.solids import Solid, lathe, loft, rotation, sweep

STAR = np.array([(2, 0), (0.5, 0.4), (0, 2), (-0.5, 0.4), (-2, 0), (-0.4, -0.5), (0, -2), (0.4, -0.5)])

SOLIDS: dict[str, Solid] = {
    "box": make.box(1, 2, 3),
    "rounded box": make.box(1, 2, 3, 0.2, 3),
    "tapered": make.tapered((1, 2), (0.5, 0.7), 3, (0.4, -0.2)),
    "cylinder": make.cylinder(0.5, 2, 12),
    "cone": make.cone(1, 0, 2, 9),
    "frustum": make.cone(1, 0.4, 2, 9),
    "ball": make.ball(1, 2, 3),
    "torus": make.torus(2, 0.5),
    "post": make.post((0, 0, 0), (0.3, 2, -0.4), 0.2, 0.1, 6),
    "rod": make.rod((0, 0, 0), (1, 1, 1), 0.1, 0.2, 4),
    "tube": make.tube([(0, 0, 0), (0, 1, 0), (1, 1.5, 0), (1, 1.5, 2)], 0.1),
    "panel": make.panel(1, 1.2, 1.5, 0.1, 0.2, 0.3, 0.8),
    "cushion": make.cushion(1, 0.2, 0.9),
    "star loft": loft([STAR, 2 * STAR, STAR + 0.5], [0, 1, 3], "x"),
    "twisted loft": loft([rectangle(1, 1), rectangle(1, 1) @ rotation("z", 30)[:2, :2].T], [0, 1]),
    "wing": loft([airfoil(2, 0.2, 6), airfoil(1, 0.1, 6) - (1, 0)], [0, 4], "y"),
    "spindle": lathe([(0, 0), (0.5, 0.4), (0.2, 1), (0, 1.5)], 10),
    "shell": lathe([(1, 0), (0.6, 1), (0.55, 1), (0.95, 0)], 16, ring=True),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_every_solid_is_closed_oriented_outwards_and_has_its_stated_volume(name):
    solid = SOLIDS[name]
    for moved in (solid, solid.mirrored(), solid.moved(1, 2, 3).turned("x", 40), solid.scaled(2, 3, 0.5)):
        mesh = bare_mesh(moved)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(moved.volume, rel=1e-9)
        assert moved.volume > 0
        assert moved.uv.shape == (len(moved.faces), 3, 2)
        assert moved.uv.min() >= 0
        assert moved.uv.max() <= 1 + 1e-12


def test_volumes_are_those_of_the_closed_forms():
    """Closed forms; a regular n-gon of circumradius r has the area n / 2 sin(2 pi / n) r^2."""

    def gon(n: int, r: float) -> float:
        return n / 2 * np.sin(2 * np.pi / n) * r**2

    assert make.box(1, 2, 3).volume == pytest.approx(6)
    assert make.cylinder(0.5, 2, 12).volume == pytest.approx(gon(12, 0.5) * 2)
    assert make.cone(1, 0, 2, 9).volume == pytest.approx(gon(9, 1) * 2 / 3)
    assert make.cone(1, 0.4, 2, 9).volume == pytest.approx(gon(9, 1) * 2 / 3 * (1 + 0.4 + 0.16))
    assert make.torus(2, 0.5, 20, 8).volume == pytest.approx(20 * np.sin(np.pi / 10) * 2 * gon(8, 0.5))  # Pappus
    # a prismatoid over two rectangles: h / 6 (A0 + 4 Am + A1), where the middle rectangle is 0.75 x 1.35
    assert make.tapered((1, 2), (0.5, 0.7), 3).volume == pytest.approx(3 / 6 * (2 + 4 * 0.75 * 1.35 + 0.35))
    assert make.rod((0, 0, 0), (2, 3, 6), 0.1, 0.2, 4).volume == pytest.approx(0.02 * 7)
    # an L of a square bar: the mitre adds the volume on one side that it removes on the other
    assert make.tube([(0, 0, 0), (0, 1, 0), (2, 1, 0)], 0.1, sides=4).volume == pytest.approx(0.01 * 3)
    # the arrow (0, 0), (2, 1), (0, 2), (1, 1) is the triangle of area 2 minus the notch of area 1
    arrow = np.array([(0, 0), (2, 1), (0, 2), (1, 1)])
    assert loft([arrow, arrow], [0, 3]).volume == pytest.approx(3 * (2 - 1))


def test_the_volume_of_a_ball_converges_to_that_of_the_sphere():
    """Property: the inscribed polyhedron converges to 4/3 pi abc, quadratically in the number of facets."""
    exact = 4 / 3 * np.pi * 6
    coarse, fine = (exact - make.ball(1, 2, 3, 8 * k, 4 * k).volume for k in (4, 8))
    assert 0 < fine < coarse
    assert coarse / fine == pytest.approx(4, rel=0.02)


@pytest.mark.parametrize(
    "outline",
    [
        rectangle(2, 1),
        rounded_rectangle(2, 1, 0.3),
        ellipse(1, 2, 9),
        superellipse(1, 1, 4, 12),
        airfoil(1, 0.12, 6),
        STAR,
    ],
)
def test_outline_is_counter_clockwise_and_triangles_tile_it(outline):
    """Property: the areas of the triangles are positive and sum to the area by the shoelace formula."""
    areas = np.array([polygon_area(outline[triangle]) for triangle in triangulate(outline)])
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(polygon_area(outline))
    assert len(areas) == len(outline) - 2


def test_outline_areas():
    """Closed forms."""
    assert polygon_area(rectangle(2, 3)) == pytest.approx(6)
    assert polygon_area(rounded_rectangle(2, 3, 0.4, 200)) == pytest.approx(6 - (4 - np.pi) * 0.16, rel=1e-5)
    assert polygon_area(superellipse(2, 2, 2, 16)) == pytest.approx(polygon_area(ellipse(1, 1, 16)))
    assert airfoil(3, 0.3, 6)[:, 0].max() == pytest.approx(3)
    # the largest thickness by the NACA formula is the nominal one
    assert np.ptp(airfoil(1, 0.12, 100)[:, 1]) == pytest.approx(0.12, rel=2e-3)


def test_axes_of_a_loft():
    """By hand: outline (a, b) = (2, 4) lies in (x, y) for z, (z, x) for y, (y, z) for x."""
    extents = {axis: np.ptp(loft([rectangle(2, 4)] * 2, [0, 6], axis).vertices, axis=0) for axis in "xyz"}
    np.testing.assert_allclose(extents["z"], (2, 4, 6))
    np.testing.assert_allclose(extents["y"], (4, 6, 2))
    np.testing.assert_allclose(extents["x"], (6, 2, 4))


def test_rotation_is_right_handed():
    """By hand: a rotation by 90 degrees about each axis maps the next axis to the one after it."""
    for axis, start, end in (("x", 1, 2), ("y", 2, 0), ("z", 0, 1)):
        np.testing.assert_allclose(rotation(axis, 90) @ np.eye(3)[start], np.eye(3)[end], atol=1e-12)


def test_projection_and_repetition_of_texture_coordinates():
    """By hand: a box projected along z, and a cylinder with three repetitions of its texture around it."""
    solid = make.box(2, 4, 6).projected("z")
    corner = solid.vertices[solid.faces]
    np.testing.assert_allclose(solid.uv, (corner[..., :2] + (1, 2)) / (2, 4))
    tube = make.cylinder(1, 1, 12)
    side = tube.cells[:, 0] >= 0
    original, repeated = tube.uv[side, :, 0], tube.repeated(3).uv[side, :, 0]
    np.testing.assert_allclose((repeated - 3 * original) % 1, np.round((repeated - 3 * original) % 1), atol=1e-12)
    assert np.ptp(repeated, axis=1).max() == pytest.approx(3 / 12)
    with pytest.raises(ValueError, match="divisor of the 12 steps around, got 5"):
        tube.repeated(5)


def test_impossible_solids_are_refused():
    with pytest.raises(ValueError, match=r"increasing stations, got \[1.0, 0.0\]"):
        loft([rectangle(1, 1)] * 2, [1, 0])
    with pytest.raises(ValueError, match="k >= 2 outlines"):
        loft([rectangle(1, 1)], [0])
    with pytest.raises(ValueError, match="positive radii"):
        lathe([(1, 0), (0, 1), (1, 2)])
    with pytest.raises(ValueError, match="centroid at the origin, got"):
        sweep([(0, 0, 0), (0, 0, 1)], rectangle(1, 1) + 1)
    with pytest.raises(ValueError, match="without an ear"):
        triangulate(rectangle(1, 1)[::-1])
