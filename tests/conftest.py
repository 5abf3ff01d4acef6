"""Setup of all tests: shapes are checked by jaxtyping and beartype, and random rays are few."""

import atexit
import gc
import os
import shutil
import signal
import sys
import tempfile
from itertools import pairwise

import pytest

SLOWEST_FIRST = (
    "test_cli",
    "test_engine",
    "test_trained",
    "test_generate",
    "test_training",
    "test_distributed",
    "test_tutorials",
    "test_any_number_of_views",
    "test_baking",
    "test_fuzz",
    "test_objects",
    "test_mesh_renderer",
    "test_benchmarks",
    "test_methods",
    "test_plane_dropout",
    "test_inputs",
)
"""Test modules that run first with `make test`, so that no slow module is the last one running."""

if "PYTEST_XDIST_WORKER" not in os.environ:  # default signal handlers, also in the background and under nohup
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

if "HYPERPLANES_TESTS" not in os.environ:  # the first process; the others inherit the variable and share the folder
    os.environ["HYPERPLANES_TESTS"] = tempfile.mkdtemp(prefix="hyperplanes-tests-")
    atexit.register(shutil.rmtree, os.environ["HYPERPLANES_TESTS"], ignore_errors=True)
os.environ["HYPERPLANES_CACHE"] = tempfile.mkdtemp(dir=os.environ["HYPERPLANES_TESTS"])  # not that of the user
os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa renders without threads, as in workers
os.fsync = lambda descriptor: None  # no test cuts the power, and the tests would wait seconds for the disk

STARTS_WORKERS = "-n" in sys.argv and ("-n", "0") not in pairwise(sys.argv) and "PYTEST_XDIST_WORKER" not in os.environ
if not STARTS_WORKERS:  # the process that starts the workers of `make test` runs no test itself
    gc.disable()  # until all modules are imported and all tests are collected
    import second_device
    import torch
    import typechecker

    second_device.register()  # autograd makes a queue per known device at the first gradient
    torch.set_num_threads(1)  # tensors are small; tests of threads set their own number
    typechecker.install("hyperplanes")

    from hyperplanes.adaptation.optimisation import learned_steps

    ALL_RAYS = learned_steps.RAYS_PER_STEP
    learned_steps.RAYS_PER_STEP = 128  # a learned step then takes a tenth of the time


@pytest.fixture(scope="module")
def all_rays():
    """Learned steps compute gradients from as many rays as outside of the tests."""
    from hyperplanes.adaptation.optimisation import learned_steps

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_steps, "RAYS_PER_STEP", ALL_RAYS)
        yield


@pytest.fixture
def unchecked(monkeypatch):
    """Disable the type checks of the tests, as for users."""
    import jaxtyping

    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def pytest_collection_modifyitems(items):
    """Slow modules first; the order of the others does not change."""
    order = {name: place for place, name in enumerate(SLOWEST_FIRST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish():
    """Exempt imported objects from garbage collection, which is rarer than usual: it took 1 to 4 % of the time."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    gc.enable()
