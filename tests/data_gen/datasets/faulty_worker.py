"""Work that fails on request, for tests of `data_gen.datasets.workers`."""

import os
import signal
import time
from pathlib import Path

from hyperplanes.utilities.files.reading import DataError


def serve(settings):
    if settings.get("broken"):
        raise RuntimeError("no renderer here")
    return lambda item: perform(item, Path(settings["folder"]))


def perform(item, folder):
    print("a library that prints to standard output")
    kind = item["kind"]
    if kind == "once":  # fails only the first time
        marker = folder / "tried"
        kind = "fine" if marker.exists() else "crash"
        marker.touch()
    if kind == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "exit":
        os._exit(3)
    if kind == "hang":
        time.sleep(600)
    if kind == "wrong":
        raise ValueError("nothing to draw\nin it")
    if kind == "bug":
        raise KeyError("colour")
    if kind == "full":
        raise DataError("disk is full")
    return {"name": item["name"], "process": os.getpid()}
