"""`view` with a fake page that records its calls. Source of truth: the help text of the verb."""

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


class RecordingViewer:
    """A page that records its calls and is never opened."""

    address = "http://127.0.0.1:0"
    made = []

    def __init__(self, views, port, on_number, others):
        self.views, self.on_number, self.others = views, on_number, others
        self.notes, self.shown_others, self.stopped = [], [], False
        self.all_shown = threading.Event()
        RecordingViewer.made.append(self)

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
    monkeypatch.setattr(live, "LiveViewer", RecordingViewer)
    RecordingViewer.made.clear()
    return RecordingViewer


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_ctrl_c_ends_a_page_without_an_error_and_a_termination_is_reported(number, code, viewer, monkeypatch, capfd):
    monkeypatch.setattr(view, "load_source", lambda *_, **__: None)

    rounds = []

    def end(page):
        os.kill(os.getpid(), number)
        time.sleep(10)
        if not page.stopped:  # the signal was ignored, and the page would wait forever
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
    assert "run the same command again" not in errors
    assert "--port: 8080 is in use" in errors  # the page uses another port
    assert ("terminated; the page is closed" in errors) == (code == 143)


def test_adapting_other_methods_stops_when_the_number_of_views_changes(monkeypatch):
    class Slow:
        def adapt(self, shown):
            wanted.put(2)  # the slider is moved meanwhile
            return shown

    wanted, page = view.queue.SimpleQueue(), RecordingViewer(None, 0, None, ["one", "two"])
    with pytest.raises(view._Superseded):
        view._show_others({"one": Slow(), "two": Slow()}, "views", page, wanted, view.Console(silent=True))
    assert page.shown_others == ["one"]


def test_a_method_that_refuses_few_views_is_reported_and_the_others_are_shown(capfd):
    class Several:
        def adapt(self, shown):
            raise ValueError("support: expected at least 2 views, got 1")

    class Any:
        def adapt(self, shown):
            return shown

    page = RecordingViewer(None, 0, None, ["scratch_2", "two"])
    others = {"scratch_2": Several(), "two": Any()}
    view._show_others(others, "views", page, view.queue.SimpleQueue(), view.Console())
    assert page.shown_others == ["scratch_2: support: expected at least 2 views, got 1", "two"]
    assert "scratch_2: support: expected at least 2 views, got 1" in capfd.readouterr().err


def test_results_of_another_number_of_views_are_removed_from_the_page(viewer, monkeypatch):
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


def test_the_model_can_be_named_by_its_method_in_compare(tmp_path):
    model = small_model(hypernetwork=None)
    model.save(tmp_path)
    names = ("point_multiplane", "hyperplanes", "nearest_view")
    found = view._others(view.Arguments(Path("example-car"), tmp_path, compare=names), torch.device("cpu"))
    assert [found[name].config for name in names[:2]] == [model.config] * 2


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "hull_bland",
            r"--compare: expected a method such as hull_blend, .*, got 'hull_bland'; did you mean hull_blend\?",
        ),
        ("maml", "--compare: method maml: expected a checkpoint of maml, got none"),
    ],
)
def test_a_method_that_cannot_be_compared_with_is_refused(name, message, tmp_path):
    small_model(hypernetwork=None).save(tmp_path)
    with pytest.raises(ValueError, match=message) as raised:
        view._others(view.Arguments(Path("example-car"), tmp_path, compare=(name,)), torch.device("cpu"))
    assert "autoencoder" not in str(raised.value)


@pytest.mark.parametrize("option", [["--steps", "1"], ["--refine-poses"], ["--learn-background"], ["--fit", "0"]])
def test_options_of_adapting_are_refused_with_a_baked_file(option, viewer, monkeypatch, capsys):
    monkeypatch.setattr(view, "load_source", lambda *_, **__: baking.BakedScene(None))
    monkeypatch.setattr(view, "read_scene", None)  # refused before images are read
    assert main(["view", "example-car", *option]) == 2
    assert f"{option[0]}: expected none with a baked file" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["baking", "fitting"])
def test_baking_stops_when_the_number_of_views_changes(part, monkeypatch):
    def move(title, done):
        told.append(title)
        if title == part and done == 2:
            wanted.put(2)  # the slider is moved meanwhile

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
