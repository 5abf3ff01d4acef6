"""Shapes are checked in tests: the package's functions run under jaxtyping and beartype."""

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
"""Modules that processes of the tests begin with (`make test`), so that none of them is left for the end."""

if "PYTEST_XDIST_WORKER" not in os.environ:  # as in a terminal, in the background and under nohup, too
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

if "HYPERPLANES_TESTS" not in os.environ:  # the first process: it starts the others, which share the folder
    os.environ["HYPERPLANES_TESTS"] = tempfile.mkdtemp(prefix="hyperplanes-tests-")
    atexit.register(shutil.rmtree, os.environ["HYPERPLANES_TESTS"], ignore_errors=True)
os.environ["HYPERPLANES_CACHE"] = tempfile.mkdtemp(dir=os.environ["HYPERPLANES_TESTS"])  # not the user's own
os.environ.setdefault("LP_NUM_THREADS", "0")  # of Mesa, when it draws in this process, as workers have it

STARTS_OTHERS = "-n" in sys.argv and ("-n", "0") not in pairwise(sys.argv) and "PYTEST_XDIST_WORKER" not in os.environ
if not STARTS_OTHERS:  # the process that starts others (`make test`) runs no test
    gc.disable()  # until everything is imported and found
    import second_device
    import torch
    import typechecker

    second_device.register()  # before the first gradient, when autograd makes a queue for each device that it knows
    torch.set_num_threads(1)  # small tensors: more threads only wait for each other; tests of threads set their own
    typechecker.install("hyperplanes")

    from hyperplanes.adaptation import learned_steps

    ALL_RAYS, learned_steps.RAYS = learned_steps.RAYS, 128  # a step takes a tenth of the time so


@pytest.fixture(scope="module")
def all_rays():
    """Learned steps by gradients of as many rays as users have."""
    from hyperplanes.adaptation import learned_steps

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_steps, "RAYS", ALL_RAYS)
        yield


@pytest.fixture
def unchecked(monkeypatch):
    """Without the type checks of the tests, as users run it."""
    import jaxtyping

    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def pytest_collection_modifyitems(items):
    """Slow modules first; the others as they were."""
    order = {name: place for place, name in enumerate(SLOWEST_FIRST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish():
    """What was imported stays until the end: the garbage collector need not look at it again and again."""
    gc.freeze()
    gc.enable()
