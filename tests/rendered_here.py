"""Generate data sets in the test process, because a worker process takes 1.3 s to start, mostly for imports.

Properties of worker processes themselves are tested with real ones: in tests/data_gen/datasets/test_workers.py, and in
those tests of test_generate.py that kill workers, count them or fill their disk.
"""

import warnings
from contextlib import contextmanager
from importlib import import_module

import pytest

from data_gen.datasets.worker_process import process_item
from data_gen.datasets.workers import Outcome, WorkerError


def run_here(target, settings, items, **_):
    """A replacement for `workers.run_isolated` that processes one item after the other in this process."""
    module, _, function = target.partition(":")
    with warnings.catch_warnings():  # warnings are errors in tests, but a worker writes them to its log
        warnings.simplefilter("default")
        process = getattr(import_module(module), function)(settings)
        for item in items:
            answer = process_item(process, item)
            if "fatal" in answer:
                raise WorkerError(answer["fatal"])
            yield Outcome(item, answer.get("ok"), answer.get("skip"))


@contextmanager
def rendered_here():
    """While active, `generate` starts no worker processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("data_gen.datasets.generate.run_isolated", run_here)
        yield
