"""Source of truth: the shading formula for white and grey surfaces, the stated bounds, and error messages."""

import numpy as np
import pytest

from data_gen.rendering.lighting import LIGHTING_PRESETS, Light, Lighting, resolve_lighting
from data_gen.rendering.shading import SHOULDER, facing, shade
from data_gen.rigs import random
from hyperplanes.utilities.images.colour import linear_from_srgb, srgb_from_linear


def _sphere_shades(lighting, albedo, towards=None):
    """Shades of a matt sphere: all normals, each seen along the normal or from one direction."""
    normals = random(400, 8, seed=0).world_from_camera[:, :3, 3] / 3.0
    views = normals if towards is None else np.broadcast_to(np.asarray(towards, float), normals.shape)
    normals = facing(normals, normals, views)
    count = len(normals)
    flat = np.full((count, 1), 0.8), np.zeros((count, 1))
    base = np.full((count, 3), albedo)
    lights = lighting.directions(np.eye(4))
    return shade(base, np.zeros((count, 3)), normals, views, *flat, lighting, lights)


def test_srgb_round_trip():
    values = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-12)


def test_lambert_closed_form():
    # One light of colour 0.5 at 60 degrees on a rough surface: (0.1 + 0.5 cos 60) x 0.6 = 0.21.
    lighting = Lighting((Light((0.0, 0.5, 3**0.5 / 2), (0.5, 0.5, 0.5)),), sky=(0.1,) * 3, ground=(0.1,) * 3)
    normal = np.array([[0.0, 1.0, 0.0]])
    one, none = np.ones((1, 1)), np.zeros((1, 1))
    colour = shade(
        np.full((1, 3), 0.6), np.zeros((1, 3)), normal, normal, one, none, lighting, lighting.directions(np.eye(4))
    )
    # The specular part of a fully rough dielectric adds between 0 and 0.02 of the light.
    assert srgb_from_linear(np.array(0.21)) < colour[0, 0] < srgb_from_linear(np.array(0.21 + 0.5 * 0.5 * 0.04))


def test_very_bright_values_are_compressed_below_white():
    lighting = Lighting((), sky=(4.0,) * 3, ground=(4.0,) * 3)
    normal = np.array([[0.0, 1.0, 0.0]])
    flat = np.ones((1, 1)), np.zeros((1, 1))
    shades = [
        shade(np.full((1, 3), albedo), np.zeros((1, 3)), normal, normal, *flat, lighting, np.zeros((0, 3)))[0, 0]
        for albedo in (SHOULDER / 4, 0.25, 0.3, 0.5)
    ]
    assert shades == sorted(shades)
    assert len(set(shades)) == 4
    assert shades[-1] < 1.0


@pytest.mark.parametrize(
    "lighting", [resolve_lighting("studio"), *(resolve_lighting("random", seed=s) for s in range(8))]
)
def test_no_side_is_black_and_no_white_is_clipped(lighting):
    white, grey = _sphere_shades(lighting, 0.9), _sphere_shades(lighting, 0.5)
    assert white.max() < 1.0
    assert grey.min() > 0.30
    # The shape is still visible: the brightest side of grey is well above the darkest.
    assert grey.max() > 1.3 * grey.min()


def test_headlight_follows_the_camera_and_the_others_do_not():
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    headlight, studio = resolve_lighting("headlight"), resolve_lighting("studio")
    np.testing.assert_allclose(headlight.directions(pose)[0], -pose[:3, 2], atol=1e-12)
    np.testing.assert_array_equal(studio.directions(pose), studio.directions(np.eye(4)))


def test_random_lights_depend_on_their_seed():
    assert resolve_lighting("random", seed=1) == resolve_lighting("random", seed=1)
    assert resolve_lighting("random", seed=1) != resolve_lighting("random", seed=2)


def test_sheets_are_lit_on_both_sides():
    up, down = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, -1.0, 0.0]])
    np.testing.assert_array_equal(facing(up, up, up), up)
    np.testing.assert_array_equal(facing(up, down, up), up)
    np.testing.assert_array_equal(facing(down, up, up), up)
    np.testing.assert_array_equal(facing(np.zeros((1, 3)), down, up), up)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: resolve_lighting("disco"), "studio, headlight, random or a Lighting, got 'disco'"),
        (lambda: Lighting((Light((0, 0, 2.0), (1, 1, 1)),), (0, 0, 0), (0, 0, 0)), "of length 2"),
        (lambda: Lighting((Light((0, 0, 1.0), (1, -1, 1)),), (0, 0, 0), (0, 0, 0)), r"got \(1, -1, 1\)"),
        (lambda: Lighting((Light((0, 0, 1.0), (1, 1, 1)),) * 5, (0, 0, 0), (0, 0, 0)), "at most 4, got 5"),
    ],
)
def test_wrong_input_is_named_in_the_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_all_presets_are_listed():
    for name in LIGHTING_PRESETS:
        assert isinstance(resolve_lighting(name), Lighting)
