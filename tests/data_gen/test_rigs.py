"""Source of truth: Kornia's projection, the stated distribution of cameras, numbers by hand, and error messages."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera

from data_gen import rigs
from data_gen.rigs import RIG_PRESETS, Rig, make_rig
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.poses import look_at


def _nearest(directions):
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -1.0)
    return np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)))


def _kornia_project(rig, points):
    views = len(rig)
    intrinsics = np.tile(np.eye(4), (views, 1, 1))
    intrinsics[:, :3, :3] = rig.intrinsics
    camera = PinholeCamera(
        torch.from_numpy(intrinsics),
        torch.from_numpy(np.linalg.inv(rig.world_from_camera)),
        torch.full((views,), float(rig.height), dtype=torch.float64),
        torch.full((views,), float(rig.width), dtype=torch.float64),
    )
    return camera.project(torch.from_numpy(np.tile(points, (views, 1, 1)))).numpy()


@pytest.mark.parametrize(
    "rig",
    [
        rigs.fixed(7, 64),
        rigs.random(7, 64, seed=1),
        rigs.random(7, 64, seed=1, lowest=0.0),
        rigs.orbit(7, 64),
        rigs.spiral(7, 64),
        rigs.orbit(3, 64, elevation=90.0),
        rigs.orbit(3, 64, elevation=-90.0),
    ],
)
def test_convention_origin_at_principal_point_and_up_is_up(rig):
    pixels = _kornia_project(rig, np.array([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]]))
    np.testing.assert_allclose(pixels[:, 0], 31.5, atol=1e-9)
    assert (pixels[:, 1, 1] <= pixels[:, 0, 1] + 1e-9).all()
    np.testing.assert_allclose(np.linalg.norm(rig.world_from_camera[:, :3, 3], axis=1), 3.0)
    assert (rig.near, rig.far) == (2.0, 4.0)


@pytest.mark.parametrize("distance", [1.5, 3.0, 8.0])
def test_unit_sphere_fits_with_a_margin(distance):
    # The silhouette of the unit sphere is a cone around the axis, with a half angle of asin(1 / distance).
    rig = rigs.fixed(1, 40, distance=distance)
    radius = rig.intrinsics[0, 0, 0] * np.tan(np.arcsin(1.0 / distance))
    assert 0.90 * 20 < radius < 0.97 * 20


def test_the_spiral_of_srn():
    """SRN's test cars have 251 views at a distance of 1.3 from cars of radius 1/2, and a focal length of 131.25 pixels.

    Its renderer increases i from 20 by 20/250. Cameras are at the azimuth i, and pi i / 40 from the lower pole.
    """
    preset = rigs.RIG_PRESETS["srn"]
    rig = rigs.make_rig("srn", 251, 128, distance=preset.distance, field_of_view=preset.field_of_view)
    assert rig.intrinsics[0, 0, 0] == pytest.approx(131.25)
    x, y, z = (rig.world_from_camera[:, :3, 3] / 2).T
    np.testing.assert_allclose(np.linalg.norm(rig.world_from_camera[:, :3, 3], axis=1) / 2, 1.3)
    steps = np.arange(251) * 20 / 250
    np.testing.assert_allclose(y, 1.3 * np.sin(np.pi * steps / 40), atol=1e-12)
    turned = np.unwrap(np.arctan2(x, z)[:-1])  # the last camera is at the pole
    np.testing.assert_allclose(turned - turned[0], -steps[:-1], atol=1e-9)


def test_the_fixed_rig_is_always_the_same_and_evenly_distributed():
    rig, again = rigs.fixed(50, 32), rigs.fixed(50, 32)
    assert np.array_equal(rig.world_from_camera, again.world_from_camera)
    directions = rig.world_from_camera[:, :3, 3] / 3.0
    # Caps of 15 degrees around 50 points cover about the same share of the band as caps of 29 degrees around 25.
    assert _nearest(directions).min() > 15.0
    assert _nearest(directions[0::2]).min() > 29.0
    assert _nearest(directions[1::2]).min() > 29.0
    elevations = np.degrees(np.arcsin(directions[:, 1]))
    assert -20.0 < elevations.min() < -15.0
    assert 70.0 < elevations.max() < 80.0


def test_the_first_views_of_each_half_of_the_fixed_rig_are_far_apart():
    directions = rigs.fixed(50, 32).world_from_camera[:, :3, 3] / 3.0
    assert _nearest(directions[0:10:2]).min() > 60.0
    assert _nearest(directions[1:11:2]).min() > 60.0


@pytest.mark.parametrize("views", [1, 2, 3, 50, 51])
def test_the_fixed_rig_has_any_number_of_views(views):
    centres = rigs.fixed(views, 16).world_from_camera[:, :3, 3]
    assert len(np.unique(centres.round(6), axis=0)) == views


def test_random_rigs_depend_on_their_seed_and_cover_their_part_of_the_sphere():
    one = rigs.random(400, 8, seed=3).world_from_camera[:, :3, 3]
    assert np.array_equal(one, rigs.random(400, 8, seed=3).world_from_camera[:, :3, 3])
    assert not np.array_equal(one, rigs.random(400, 8, seed=4).world_from_camera[:, :3, 3])
    # Uniform on the sphere: each coordinate of the mean of 400 has standard deviation sqrt(1 / 3 / 400) = 0.029.
    assert np.abs((one / 3.0).mean(axis=0)).max() < 0.12
    upper = rigs.random(400, 8, seed=3, lowest=0.0).world_from_camera[:, :3, 3] / 3.0
    assert upper[:, 1].min() >= 0.0
    assert abs(upper[:, 1].mean() - 0.5) < 0.05


def test_presets():
    assert set(RIG_PRESETS) == {"paper-128", "paper-200", "srn"}
    papers = [RIG_PRESETS[name] for name in ("paper-128", "paper-200")]
    assert [(preset.views, preset.resolution) for preset in papers] == [(50, 128), (50, 200)]
    small, large = (
        [make_rig(name, 50, 16, seed=seed).world_from_camera for seed in (5, 6)] for name in ("paper-128", "paper-200")
    )
    assert {preset.distance for preset in papers} == {4.0}  # both loaders have near 2 and far 6
    focal = 100 / np.tan(np.radians(RIG_PRESETS["paper-200"].field_of_view) / 2)
    assert focal == pytest.approx(277.77, abs=0.01)  # as in the authors' loader
    assert not np.array_equal(*small)
    assert np.array_equal(*large)
    with pytest.raises(ValueError, match="paper-128, paper-200, srn, got 'paper-64'"):
        make_rig("paper-64", 50, 16)


def test_poses_are_those_of_the_cameras_of_hyperplanes():
    rig = replace(rigs.fixed(6, 10), width=20)
    part = camera.select(rig.cameras(), [4, 0])
    assert camera.image_size(part) == (10, 20)
    expected = look_at(torch.from_numpy(rig.world_from_camera[[4, 0], :3, 3]))
    assert torch.allclose(camera.camera_from_world(part), expected, atol=1e-12)
    assert torch.equal(camera.intrinsics(part), torch.from_numpy(rig.intrinsics[[4, 0]]))
    assert np.allclose(camera.centres(part).numpy(), rig.world_from_camera[[4, 0], :3, 3], atol=1e-12)


def test_above_and_below_the_origin_the_top_of_the_image_is_the_same_axis():
    centres = np.array([[0.0, 3.0, 0.0], [0.0, -2.0, 0.0], [1e-7, 3.0, 0.0], [1e-5, 3.0, 0.0], [0.0, 1.0, 2.0]])
    expected = torch.linalg.inv(look_at(torch.from_numpy(centres)))
    np.testing.assert_allclose(rigs.look_at_origin(centres), expected, atol=1e-9)


def test_one_intrinsic_matrix_serves_all_views():
    rig = rigs.fixed(4, 16)
    same = Rig(rig.world_from_camera, rig.intrinsics[0], 16, 16, 2.0, 4.0)
    assert np.array_equal(same.intrinsics, rig.intrinsics)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rigs.fixed(0, 16), r"got \(0, 4, 4\)"),
        (lambda: rigs.fixed(4, 0), "at least 1 pixel, got 0"),
        (lambda: rigs.fixed(4, 16, distance=1.0), "more than 1.04 .* got 1.0"),
        (lambda: rigs.fixed(4, 16, distance=math.inf), "distance: expected a finite number .* got inf"),
        (lambda: rigs.fixed(4, 16, field_of_view=180.0), "got 180.0"),
        (lambda: Rig(np.eye(4), np.eye(3), 4, 4, 1, 2), r"got \(4, 4\)"),
        (lambda: Rig(np.eye(4)[None], np.eye(4), 4, 4, 1, 2), r"got \(4, 4\)"),
        (lambda: Rig(np.eye(4)[None], np.eye(3) + 0.5 * np.eye(3, k=1), 4, 4, 1, 2), "expected no skew, got 0.5$"),
        (lambda: Rig(2 * np.eye(4)[None], np.eye(3), 4, 4, 1, 2), "without scale or mirroring"),
        (lambda: Rig(np.diag([1.0, 1, -1, 1])[None], np.eye(3), 4, 4, 1, 2), "determinants from -1"),
        (lambda: Rig(np.eye(4)[None] * np.nan, np.eye(3), 4, 4, 1, 2), "NaN"),
        (lambda: Rig(np.eye(4)[None], np.eye(3), 4, 0, 1, 2), "got 4 x 0"),
        (lambda: Rig(np.eye(4)[None], np.eye(3), 4, 4, 2, 2), "got 2 and 2"),
    ],
)
def test_wrong_input_is_named_in_the_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()
