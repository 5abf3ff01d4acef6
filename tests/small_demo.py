"""A small demonstration, made once for all tests that use its data set, checkpoints and page."""

import atexit
import fcntl
import functools
import os
import shutil
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from rendered_here import rendered_here
from small_packaged import small_packaged

from hyperplanes.cli import main
from hyperplanes.experiments.configurations import configuration
from hyperplanes.experiments.demonstration.settings import DemoSettings

FEW = {"steps": 10, "frames": 2, "tuning": (0, 2)}


@contextmanager
def small_demo():
    """While active, `hyperplanes demo --quick-check` trains fewer steps, fine-tunes less and renders fewer frames."""
    usual = DemoSettings.quick_check
    with rendered_here(), small_packaged(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(DemoSettings, "quick_check", lambda seed=0: replace(usual(seed), **FEW))
        yield


@functools.cache
def demo_folder():
    """The folder of `hyperplanes demo --quick-check` in `small_demo`; each test process has its own copy."""
    shared = Path(os.environ["HYPERPLANES_TESTS"])
    with open(shared / "lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the first process makes it
        if not (shared / "demo").exists():
            with small_demo():
                assert main(["demo", "--quick-check", "--out", str(shared / "unfinished")]) == 0
            (shared / "unfinished").rename(shared / "demo")
    folder = Path(tempfile.mkdtemp(prefix="hyperplanes-demo-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(shutil.copytree(shared / "demo", folder / "demo"))


def demo_preset():
    """The preset with the model and the training of the demonstration."""
    settings = replace(DemoSettings.quick_check(), **FEW)
    trained = next(each for each in settings.table.trainings if each.method == "hyperplanes")
    return configuration(settings.table, trained, settings.scale, settings.objects, settings.seed)


def first_object(folder):
    """The folder of the first held-out object."""
    return min(path for path in (folder / "data").iterdir() if "test" in path.name)
