"""Every verb handles Ctrl-C and SIGTERM with one line, an exit code, and no incomplete file."""

import ctypes
import os
import signal
import weakref
from pathlib import Path

import pytest
from small_demo import demo_folder, first_object

from hyperplanes.cli import main
from hyperplanes.utilities.machine.interrupts import Terminated, interruptible, keep_handlers

SCENE = ["--checkpoint", "{demo}", "--views", "{scene}", "--out"]
CALLS = {
    "generate": ["--class", "car", "--count", "3", "--resolution", "16", "--views", "4", "--out", "{out}"],
    "train": ["--data", "{demo}/data", "--model.network.planes", "6", "--out", "{out}"],
    "evaluate": ["--data", "{demo}/data", "--method", "nearest_view", "--json", "{out}/scores.json"],
    "adapt": [*SCENE, "{out}", "--steps", "2"],
    "render": [*SCENE, "{out}"],
    "export": [*SCENE, "{out}", "--what", "turntable", "--frames", "2"],
    "bake": [*SCENE, "{out}/baked.safetensors", "--voxels", "16", "--fit", "2"],
    "inspect": ["{demo}/data", "--out", "{out}"],
    "demo": ["--quick-check", "--out", "{out}"],
    "reproduce": ["target", "--scale", "smoke", "--out", "{out}"],
}


@pytest.fixture(autouse=True)
def _interruptible():
    """Install Python's SIGINT handler, because tests that a script runs in the background inherit an ignored SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def children():
    tasks = Path("/proc/self/task").glob("*/children")
    return {pid for task in tasks for pid in task.read_text().split()}


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("verb", CALLS)
def test_a_signal_while_a_file_is_written_leaves_nothing_behind(verb, number, code, tmp_path, monkeypatch, capsys):
    sync = os.fsync

    def signalled(descriptor):
        monkeypatch.setattr(os, "fsync", sync)
        signal.raise_signal(number)

    demo, out, before = demo_folder(), tmp_path / "out", children()
    given = [each.format(demo=demo, scene=first_object(demo), out=out) for each in CALLS[verb]]
    monkeypatch.setattr(os, "fsync", signalled)
    capsys.readouterr()
    assert main([verb, *given]) == code
    ending = "interrupted" if code == 130 else "terminated"
    resumes = verb in ("generate", "train", "demo", "reproduce")
    advice = "the same command resumes where possible" if resumes else "run the same command again to start over"
    assert capsys.readouterr().err == f"hyperplanes {verb}: {ending}; {advice}\n"
    assert not [path for path in out.rglob("*") if path.suffix == ".part" or path.name == ".lock"]
    assert children() <= before


def test_an_interrupt_that_a_callback_ignores_is_raised_again(capfd):
    """Python only prints exceptions of callbacks of weak references, so that this loop would not end."""
    before = signal.getsignal(signal.SIGTERM)

    class Value:
        pass

    def wait():
        value = Value()
        reference = weakref.ref(value, lambda _: signal.raise_signal(signal.SIGTERM))
        del value
        while reference() is None:
            pass

    with pytest.raises(Terminated), interruptible():
        wait()
    assert capfd.readouterr().err == ""
    assert signal.getsignal(signal.SIGTERM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0, 0)


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interruptible():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_cleanup_is_not_interrupted_again(monkeypatch):
    monkeypatch.setattr("hyperplanes.utilities.machine.interrupts.AGAIN_SECONDS", 0.01)
    ended = []

    def work():
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.pause()  # until the timer
            signal.pause()
            ended.append(True)

    with pytest.raises(KeyboardInterrupt), interruptible():
        work()
    assert ended


def test_handlers_that_native_code_replaces_are_restored():
    """The import of `pycolmap` installs its own SIGTERM handler; here, libc is used to ignore the signal."""

    def ignored_by_libc():
        with keep_handlers():
            ctypes.CDLL(None).signal(signal.SIGTERM, ctypes.c_void_p(int(signal.SIG_IGN)))
        signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Terminated), interruptible():
        ignored_by_libc()
