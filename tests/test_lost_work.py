"""Source of truth: files from before a command that fails or is refused, which must not change."""

import errno
import json
import os
import shutil
import subprocess
import sys

import pytest
from small_demo import demo_folder, first_object

from hyperplanes.cli import main
from hyperplanes.commands.output.console import Console
from hyperplanes.utilities.files.writing import one_writer
from tests.fuzz.corpus import llff


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def demo(tmp_path):
    for part in ("hyperplanes", "data"):
        shutil.copytree(demo_folder() / part, tmp_path / "demo" / part)
    return tmp_path / "demo"


def test_results_do_not_replace_their_inputs(demo, tmp_path, capsys):
    model, scene = demo / "hyperplanes", first_object(demo)
    llff(tmp_path / "llff")
    render = ["render", "--checkpoint", str(model), "--views"]
    before = files(tmp_path)
    for command in (
        ["adapt", "--checkpoint", str(model), "--views", str(scene), "--out", str(model)],
        ["adapt", "--checkpoint", str(demo), "--views", str(scene), "--out", str(model)],
        ["bake", "--checkpoint", str(model), "--views", str(scene), "--out", str(model / "model.safetensors")],
        [*render, str(scene), "--out", str(scene / "masks")],
        [*render, str(scene), "--out", str(scene / "images" / "new")],
        ["inspect", str(tmp_path / "llff"), "--out", str(tmp_path / "llff" / "images")],
        ["inspect", str(demo / "data"), "--out", str(scene / "images")],
        ["evaluate", "--data", str(scene), "--method", "nearest_view", "--json", str(scene / "transforms.json")],
        ["evaluate", "--data", str(scene), "--method", "nearest_view", "--csv", str(scene)],
    ):
        assert main(command) == 2, command
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert "expected" in line
        assert "; name" in line
        assert files(tmp_path) == before, command


def test_a_broken_object_does_not_lose_the_results_of_the_others(demo, tmp_path, capsys):
    names = json.loads((demo / "data/manifest.json").read_text())["splits"]["test"]
    (demo / "data" / names[-1] / "transforms.json").write_text("{")
    command = ["evaluate", "--data", str(demo / "data"), "--method", "nearest_view", "hull_blend"]
    assert main([*command, "--json", str(tmp_path / "table.json")]) == 1
    told = capsys.readouterr()
    assert f"{names[-1]} is left out, nearest_view failed: " in told.err
    assert f"1 of {len(names)} objects are left out: {names[-1]}" in told.err
    assert [*json.loads((tmp_path / "table.json").read_text())["hull_blend"]["objects"]] == names[:-1]
    assert not (tmp_path / "table.partial.json").exists()


def test_the_table_is_shown_before_it_is_written(demo, tmp_path, capsys, monkeypatch):
    def full(path, value):
        if "partial" not in path.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        path.write_text(json.dumps(value))

    monkeypatch.setattr("hyperplanes.utilities.files.writing.write_json", full)
    command = ["evaluate", "--data", str(demo / "data"), "--method", "nearest_view"]
    assert main([*command, "--json", str(tmp_path / "table.json")]) == 2
    told = capsys.readouterr()
    assert "nearest_view" in told.out
    assert "dB" in told.out
    assert "full disk" in told.err
    assert json.loads((tmp_path / "table.partial.json").read_text())["nearest_view"]["objects"]


def test_files_that_a_killed_process_left_half_written_are_removed(tmp_path):
    """Files of an ended process, of this process, and of one in a folder that another process has locked."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (tmp_path / "best").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".lock").touch()
    stale = [tmp_path / f".a.{ended.pid}-0.part", tmp_path / "best" / f".b.json.{ended.pid}-3.part"]
    kept = [tmp_path / f".a.{os.getpid()}-0.part", tmp_path / "other" / f".a.{ended.pid}-0.part", tmp_path / ".part"]
    for path in (*stale, *kept):
        path.touch()
    with one_writer(tmp_path):
        assert not any(path.exists() for path in stale)
    assert all(path.exists() for path in kept)


def test_a_closed_terminal_is_written_to_without_an_error(monkeypatch):
    class Closed:
        encoding = "utf-8"

        def isatty(self):
            return True

        def write(self, text=""):
            raise OSError(errno.EIO, os.strerror(errno.EIO))

        flush = write

    monkeypatch.setattr(sys, "stdout", Closed())
    monkeypatch.setattr(sys, "stderr", Closed())
    console = Console()
    with console.bar("training") as bar:
        bar.show(1, 2, "a line")
        bar.warn("a warning")
    console.say("done")
