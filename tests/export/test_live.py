"""The page by viser. Sources of truth: cameras of this package, and pictures counted through viser's interface."""

import math
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from hyperplanes.export import live
from hyperplanes.export.live import LiveViewer, beside, viewed_camera
from hyperplanes.geometry import cameras as camera
from hyperplanes.rendering.images import Pictures
from hyperplanes.views import Views

CAMERAS = camera.pinhole(camera.symmetric_intrinsics(16, 24, 0.7), camera.fibonacci_sphere(3, 3.0), 16, 24)


def test_the_camera_of_a_visitor():
    # Source of truth: the camera from which the rotation, position and field of view of the visitor come.
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


@pytest.mark.parametrize(("fov", "aspect"), [(0.7, 0.0), (0.7, math.nan), (0.7, math.inf), (0.0, 1.0), (math.pi, 1.0)])
def test_a_page_without_a_size_has_no_camera(fov, aspect):
    with pytest.raises(ValueError, match="camera: expected an aspect above 0 and an angle below 180 degrees"):
        viewed_camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), fov, aspect, 16)


def test_a_very_wide_page_gets_a_picture_of_bounded_width():
    height, width = camera.image_size(viewed_camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 0.7, 100.0, 1024))
    assert width <= live.MAX_WIDTH
    assert width / height == pytest.approx(100, rel=0.02)


class Visitor:
    """A visitor of the page that counts its pictures."""

    def __init__(self, aspect):
        self.client_id, self.scene, self.pictures, self.drawn = id(self), self, 0, threading.Event()
        self.camera = SimpleNamespace(
            wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]), position=torch.tensor([0.0, 0.0, -3.0]), fov=0.7, aspect=aspect
        )

    def set_background_image(self, picture, kind, jpeg_quality):
        self.pictures += 1
        self.drawn.set()


class Grey:
    """A field with grey pictures, of which one rendering can fail."""

    def __init__(self):
        self.fails = False

    def render(self, cameras):
        if self.fails:
            self.fails = False
            raise RuntimeError("out of memory")
        ones = torch.ones(1, 1, *camera.image_size(cameras))
        return Pictures(0.5 * ones.expand(1, 3, -1, -1), ones, ones, 0)


@contextmanager
def drawing(visitors, shown):
    """A page without a server, whose thread renders inside the context."""
    page = object.__new__(LiveViewer)
    page._shown, page._others, page._chosen, page._height, page._text = shown, {}, live.ALONE, 48, "25 views"
    page._changed, page._stopped, page._note = threading.Condition(), False, SimpleNamespace(content="25 views")
    page._notes, page._visits = {}, {each.client_id: live._Visit(time.monotonic()) for each in visitors}
    page._server = SimpleNamespace(get_clients=lambda: {each.client_id: each for each in visitors})
    worker = threading.Thread(target=page._draw, daemon=True)
    worker.start()
    try:
        yield page
    finally:
        with page._changed:
            page._stopped = True
            page._changed.notify()
        worker.join(20)
        assert not worker.is_alive()


def test_one_visitor_without_a_size_does_not_stop_the_pictures_of_others():
    broken, whole = Visitor(0.0), Visitor(1.5)
    with drawing([broken, whole], Grey()) as page:
        assert whole.drawn.wait(20)
        assert not broken.pictures
        assert page._note.content == "25 views"


def test_a_failed_picture_is_reported_until_the_next_one(caplog):
    visitor, shown = Visitor(1.5), Grey()
    shown.fails = True
    with drawing([visitor], shown) as page:
        deadline = time.monotonic() + 20
        while page._note.content == "25 views" and time.monotonic() < deadline:
            time.sleep(0.01)
        assert page._note.content == "a picture could not be drawn: out of memory"
        assert not visitor.pictures
        page.show(shown, "26 views")
        assert visitor.drawn.wait(20)
        assert page._note.content == "26 views"
    assert "out of memory" in caplog.text


def test_the_error_of_another_method_is_shown_while_it_is_chosen():
    with drawing([], Grey()) as page:
        page.show_other("scratch_2", None, "scratch_2: expected 2 views")
        assert page._note.content == "25 views"
        page._choose("scratch_2")
        assert page._note.content == "25 views\n\nscratch_2: expected 2 views"
        page.show_other("scratch_2", Grey())
        assert page._note.content == "25 views"


def test_a_visitor_who_moves_the_camera_does_not_block_others():
    class Slow(Grey):
        def render(self, cameras):
            with page._changed:  # the camera moved again while the picture was drawn
                page._visits[first.client_id].move()
            return super().render(cameras)

    first, second = Visitor(1.5), Visitor(1.5)
    with drawing([first, second], None) as page:
        page.show(Slow(), "25 views")
        assert second.drawn.wait(20)
        second.drawn.clear()
        with page._changed:
            page._visits[second.client_id].move()
        before = first.pictures
        assert second.drawn.wait(20)
        assert first.pictures <= before + 2


def test_a_visitor_who_has_gone_is_forgotten():
    stays, leaves = Visitor(1.5), Visitor(1.5)
    with drawing([stays, leaves], Grey()) as page:
        page._server.get_clients = lambda: {stays.client_id: stays}
        page.show(Grey(), "26 views")
        deadline = time.monotonic() + 20
        while leaves.client_id in page._visits and time.monotonic() < deadline:
            time.sleep(0.01)
        assert list(page._visits) == [stays.client_id]
        page._leave(stays)
        assert not page._visits


def test_frusta_are_shown_for_the_chosen_views_if_switched_on(monkeypatch):
    class Handle(SimpleNamespace):
        visible = True

        def on_update(self, callback):
            self.move = callback

    def add(name, *values, **_):
        made[name] = Handle(value=values[-1] if values else None)
        return made[name]

    gui = SimpleNamespace(add_markdown=add, add_checkbox=add, add_slider=add)
    scene = SimpleNamespace(add_camera_frustum=add, set_up_direction=lambda _: None)
    server = SimpleNamespace(
        gui=gui, scene=scene, on_client_connect=lambda _: None, on_client_disconnect=lambda _: None, stop=lambda: None
    )
    made, wanted = {}, []
    monkeypatch.setattr(live, "require_viewer", lambda: None)
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=lambda *_, **__: server))
    page = LiveViewer(Views(torch.rand(3, 3, 16, 24), CAMERAS), on_number=wanted.append)
    for number, switched in ((2, True), (2, False), (1, False), (1, True), (3, True)):
        made["support views"].value, made["photographs"].value = number, switched
        made["support views" if switched else "photographs"].move(None)
        shown = [made[f"/photographs/{view}"].visible for view in range(3)]
        assert shown == [switched and view < number for view in range(3)]
    assert wanted == [2, 1, 3]
    page.stop()
