"""`view` with a page that notes what it is told. Source of truth: what the verb's help says."""

import os
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from hyperplanes.cli import main
from hyperplanes.commands import view
from hyperplanes.export import baking, live, voxel_fitting
from tests.reference_rendering import small_model


class NotingViewer:
    """A page that nobody opens."""

    address = "http://127.0.0.1:0"
    made = []

    def __init__(self, views, port, on_number, others):
        self.views, self.on_number, self.others = views, on_number, others
        self.notes, self.shown_others, self.stopped = [], [], False
        self.all_shown = threading.Event()
        NotingViewer.made.append(self)

    def show(self, shown, note):
        self.notes.append(note)

    def show_other(self, name, shown, note=""):
        self.shown_others.append(name if shown is not None else note)
        if name == self.others[-1]:
            self.all_shown.set()

    def stop(self):
        self.stopped = True


@pytest.fixture
def viewer(monkeypatch):
    monkeypatch.setattr(live, "require_viewer", lambda: None)
    monkeypatch.setattr(live, "LiveViewer", NotingViewer)
    NotingViewer.made.clear()
    return NotingViewer


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_ctrl_c_is_how_a_page_ends_and_a_termination_says_so(number, code, viewer, monkeypatch, capfd):
    monkeypatch.setattr(view, "load_source", lambda *_, **__: None)

    rounds = []

    def end(page):
        os.kill(os.getpid(), number)
        time.sleep(10)
        if not page.stopped:  # swallowed: the page would wait for ever
            page.on_number(1)

    def adapt(model, shown, arguments, page, wanted, console):
        rounds.append(page)
        assert len(rounds) == 1, "went on"
        threading.Thread(target=end, args=[page], daemon=True).start()

    monkeypatch.setattr(view, "_adapt", adapt)
    monkeypatch.setattr(view, "prepare_task", lambda arguments, task, *_, **__: task)
    assert main(["view", "example-car", "--fit", "0"]) == code
    assert viewer.made[0].stopped
    errors = capfd.readouterr().err
    assert "resumes where possible" not in errors
    assert "--port: 8080 is in use" in errors  # the page has another
    assert ("terminated; the page is closed" in errors) == (code == 143)


def test_other_methods_give_way_to_another_number_of_views(monkeypatch):
    class Slow:
        def adapt(self, shown):
            wanted.put(2)  # somebody moves the slider meanwhile
            return shown

    wanted, page = view.queue.SimpleQueue(), NotingViewer(None, 0, None, ["one", "two"])
    with pytest.raises(view._Superseded):
        view._show_others({"one": Slow(), "two": Slow()}, "views", page, wanted, view.Console(silent=True))
    assert page.shown_others == ["one"]


def test_a_method_that_does_not_take_so_few_views_is_noted_and_the_page_goes_on(capfd):
    class Several:
        def adapt(self, shown):
            raise ValueError("support: expected at least 2 views, got 1")

    class Any:
        def adapt(self, shown):
            return shown

    page = NotingViewer(None, 0, None, ["scratch_2", "two"])
    others = {"scratch_2": Several(), "two": Any()}
    view._show_others(others, "views", page, view.queue.SimpleQueue(), view.Console())
    assert page.shown_others == ["scratch_2: support: expected at least 2 views, got 1", "two"]
    assert "scratch_2: support: expected at least 2 views, got 1" in capfd.readouterr().err


def test_what_was_made_of_another_number_of_views_is_taken_off_the_page(viewer, monkeypatch):
    class Copied:
        def adapt(self, shown):
            return shown

    def adapt(model, shown, arguments, page, wanted, console):
        page.shown_others.append(len(shown))
        if len(shown) == 1:
            raise KeyboardInterrupt
        page.on_number(1)

    monkeypatch.setattr(view, "load_source", lambda *_, **__: None)
    monkeypatch.setattr(view, "prepare_task", lambda arguments, task, *_, **__: task)
    monkeypatch.setattr(view, "_others", lambda *_: {"nearest_view": Copied()})
    monkeypatch.setattr(view, "_adapt", adapt)
    assert view.run(view.Arguments(Path("example-car"))) == 0
    *_, removed, number = viewer.made[0].shown_others
    assert (removed, number) == ("nearest_view: not adapted yet", 1)


def test_the_model_is_compared_with_by_the_name_of_its_method_too(tmp_path):
    model = small_model(hypernetwork=None)
    model.save(tmp_path)
    names = ("point_multiplane", "hyperplanes", "nearest_view")
    found = view._others(view.Arguments(Path("example-car"), tmp_path, compare=names), torch.device("cpu"))
    assert [found[name].config for name in names[:2]] == [model.config] * 2


@pytest.mark.parametrize("option", [["--steps", "1"], ["--refine-poses"], ["--learn-background"], ["--fit", "0"]])
def test_a_baked_file_is_finished(option, viewer, monkeypatch, capsys):
    monkeypatch.setattr(view, "load_source", lambda *_, **__: baking.BakedScene(None))
    monkeypatch.setattr(view, "read_scene", None)  # refused before pictures are read
    assert main(["view", "example-car", *option]) == 2
    assert f"{option[0]}: expected none with a baked file" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["baking", "fitting"])
def test_voxels_give_way_to_another_number_of_views(part, monkeypatch):
    def move(title, done):
        told.append(title)
        if title == part and done == 2:
            wanted.put(2)  # somebody moves the slider meanwhile

    def bake(field, side, on_part):
        for done in range(1, 5):
            move("baking", done)
            on_part(done, 4)
        return SimpleNamespace(values=())

    def fit_voxels(baked, shown, guide, steps, on_step):
        for done in range(1, 1 + steps):
            move("fitting", done)
            on_step(done)

    wanted, told, silent = view.queue.SimpleQueue(), [], view.Console(silent=True)
    monkeypatch.setattr(baking, "bake", bake)
    monkeypatch.setattr(voxel_fitting, "fit_voxels", fit_voxels)
    monkeypatch.setattr(voxel_fitting, "render_guide", lambda *_: None)
    with pytest.raises(view._Superseded):
        view.bake_field(None, [], 8, fit=9, console=silent, check=lambda: view._check(wanted))
    assert told == {"baking": ["baking"] * 2, "fitting": ["baking"] * 4 + ["fitting"] * 2}[part]
