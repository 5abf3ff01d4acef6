"""Missing memory, disk space or home folder. Source of truth: one line of error message and exit code 2."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.fine_tuned import FineTuned
from hyperplanes.adaptation.fine_tuning import NoProgressError
from hyperplanes.cli import main
from hyperplanes.commands.inputs import fields
from hyperplanes.commands.inputs.disk_cache import kept_folder
from hyperplanes.commands.output.console import Console
from hyperplanes.configuration.fine_tuning import FineTuning
from hyperplanes.data import read_views
from hyperplanes.geometry.kernels import compiling
from hyperplanes.methods import Unchecked
from hyperplanes.rendering.renderer import render
from hyperplanes.utilities.machine import memory
from hyperplanes.utilities.machine.environment import cache_folder
from tests.fuzz.corpus import data_set, posed_scene, small_model
from tests.reference_rendering import ring

GIGABYTE = 10**9


@pytest.fixture
def scene(tmp_path):
    posed_scene(tmp_path / "scene")
    small_model().save(tmp_path / "model")
    return tmp_path


def error_line(capsys):
    lines = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in "".join(lines)
    return lines[-1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["export", "--what", "mesh", "--voxels", "3000"],
            "voxels: expected a size that fits into the .* memory.*3000",
        ),
        (["export", "--what", "turntable", "--size", "200000"], "cameras: expected .* got 1 of 200000x166667, which"),
        (
            ["render", "--orbit", "2", "--size", "200000"],
            "cameras: expected .* got 1 of 200000x166667, which",
        ),
        (["render", "--device", "meta"], "device: expected auto, cpu or one that torch has here, got 'meta'"),
    ],
)
def test_sizes_that_do_not_fit_into_memory_are_refused_in_one_line(options, message, scene, capsys, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 64 * GIGABYTE)
    where = ["--checkpoint", str(scene / "model"), "--views", str(scene / "scene"), "--out", str(scene / "out")]
    assert main([*options, *where]) == 2
    assert re.search(message, error_line(capsys))


@pytest.mark.parametrize("option", ["--devices", "--nodes"])
def test_training_with_no_process_is_refused(option, tmp_path, capsys):
    data_set(tmp_path / "data")
    command = ["train", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), option, "0"]
    assert main(command) == 2
    assert error_line(capsys) == f"hyperplanes train: {option}: expected at least 1, got 0"


def test_available_memory_is_known_and_small_amounts_are_not_checked(monkeypatch):
    assert 0 < memory.available_memory() < 2**50
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    memory.require_memory("views", 3, memory.UNCHECKED_BYTES, "take fewer")
    with pytest.raises(ValueError, match=r"views: expected a size that fits .* 0\.0 GB .* got 3, which needs 5 GB"):
        memory.require_memory("views", 3, 5e9, "take fewer")


def test_cached_files_count_as_available_memory(monkeypatch):
    """A control group with a limit of 16 GiB and 15 GiB in use, 13 of them for cached files."""
    files = {"max": f"{16 * 2**30}", "current": f"{15 * 2**30}", "stat": f"anon {2**31}\ninactive_file {13 * 2**30}"}
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, **how: files.get(path.name.removeprefix("memory."), ""))
    assert memory.available_memory() == 14 * 2**30
    monkeypatch.setattr(Path, "read_text", read)


@pytest.mark.parametrize("asked", [["--help"], ["presets", "--help"]])
def test_standard_output_to_a_full_disk_is_reported_in_one_line(asked):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "hyperplanes", *asked], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "expected room to write, found a full disk" in done.stderr


def test_a_user_without_a_home_has_a_cache(monkeypatch):
    """As in a container that runs with a numeric user id, without HOME and without an entry in the password file."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert cache_folder().name == f"cache-of-{os.getuid()}"
    assert cache_folder().is_absolute()


def no_room(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_kernels_are_compiled_in_another_folder_if_the_disk_is_full(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiling.tempfile, "TemporaryFile", no_room)
    with pytest.warns(UserWarning, match=rf"{tmp_path}.*No space left on device; kernels are compiled into (.*) for"):
        folder = Path(compiling._cache_folder.__wrapped__())
    assert folder.is_dir()
    assert not folder.is_relative_to(tmp_path)
    compiling._remove(str(folder), os.getpid() + 1)  # as in a forked process
    assert folder.is_dir()
    compiling._remove(str(folder), os.getpid())
    assert not folder.exists()


def test_a_field_that_cannot_be_cached_is_returned(scene, monkeypatch, capsys):
    monkeypatch.setattr(fields, "WORTH_KEEPING", -1.0)
    monkeypatch.setattr("hyperplanes.commands.inputs.disk_cache.keep_field", no_room)
    model, views = HyperPlanes.from_pretrained(scene / "model"), read_views(scene / "scene")
    field, _ = fields.adapt_to(model, views, "a", Console())
    folder = kept_folder(model, views, 0, FineTuning())
    assert f"{folder}: not kept for later commands: " in capsys.readouterr().err
    assert field.density(torch.zeros(1, 3)).shape == (1,)


def test_densities_below_zero_are_refused():
    def field(points, _):
        return torch.zeros_like(points), points[:, 0]

    with pytest.raises(ValueError, match=r"field: expected densities of 0 or more, got -.*softplus or relu"):
        render(field, ring(1, (4, 4)))


@pytest.mark.parametrize("rate", [1e3, 1e30])
def test_fine_tuning_with_a_too_high_rate_is_refused(scene, rate):
    """With the lower rate pictures become empty, with the higher one weights become NaN."""
    model, views = HyperPlanes.from_pretrained(scene / "model"), read_views(scene / "scene")
    settings = FineTuning(optimiser="adam", learning_rate=rate, rays=64)
    with pytest.raises(NoProgressError, match=r"fine-tuning: expected 5 steps to lower .*; lower learning_rate and"):
        model.fine_tune(views, 5, settings)
    if rate == 1e3:  # tables of methods use the result anyway
        empty = Unchecked(FineTuned(model, 5, settings)).adapt(views).render(views[:1].cameras).images
        assert torch.isfinite(empty).all()
