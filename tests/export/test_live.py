"""The page by viser. Source of truth: our own cameras, and a client's messages counted through viser's interface."""

import math
import urllib.request

import pytest
import torch

from hyperplanes.export import live
from hyperplanes.export.live import LiveViewer, beside, viewed_camera
from hyperplanes.geometry import cameras as camera
from hyperplanes.rendering.images import Pictures
from hyperplanes.views import Views

CAMERAS = camera.pinhole(camera.symmetric_intrinsics(16, 24, 0.7), camera.fibonacci_sphere(3, 3.0), 16, 24)


def test_the_camera_of_a_visitor():
    # Source of truth: the camera whose rotation, place and field of view the visitor was given.
    one = camera.select(CAMERAS, [1])
    rotation = live._quaternion(camera.camera_from_world(one)[0, :3, :3].T)
    fov = 2 * math.atan(16 / 2 / float(camera.intrinsics(one)[0, 1, 1]))
    found = viewed_camera(rotation, camera.centres(one)[0].tolist(), fov, 24 / 16, 16)
    torch.testing.assert_close(found.extrinsics, one.extrinsics, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.intrinsics, one.intrinsics, atol=1e-4, rtol=0)
    assert camera.image_size(found) == (16, 24)


def test_two_methods_share_a_picture():
    def pictures(value):
        ones = torch.ones(1, 1, 4, 6)
        return Pictures(value * ones.expand(1, 3, 4, 6), ones, ones, 0)

    found = beside(pictures(0.2), pictures(0.8))
    assert found[0, 0, 0].tolist() == pytest.approx([0.2, 0.2, 0.2, 0.5, 0.8, 0.8])


def test_the_page_is_served_and_closed():
    pytest.importorskip("viser", reason="viser is not installed; pip install hyperplanes[viz]")
    viewer = LiveViewer(
        Views(torch.rand(3, 3, 16, 24), CAMERAS), port=0, on_number=lambda _: None, others=["hull_blend"]
    )
    try:
        with urllib.request.urlopen(viewer.address, timeout=20) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read()
    finally:
        viewer.stop()
