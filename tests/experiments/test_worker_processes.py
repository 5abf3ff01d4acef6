"""Source of truth: what the operating system does to a process, and what is left to say of it."""

import multiprocessing
import os
import signal
from functools import partial
from operator import methodcaller
from types import SimpleNamespace

import pytest

from hyperplanes.experiments.workers import Workers


def workers(**methods):
    """Two processes whose work has these methods."""
    return Workers(2, partial(SimpleNamespace, data=SimpleNamespace(generated={}), **methods))


def test_of_a_worker_that_is_killed_one_line_is_said():
    """Source of truth: SIGKILL, as a system that runs out of memory sends it."""
    pool = workers(end=partial(signal.raise_signal, signal.SIGKILL))
    with pytest.raises(ChildProcessError, match="one was killed .*; give fewer --workers, and the same"), pool:
        pool.submit({}, methodcaller("end")).result()


def test_ctrl_c_while_a_worker_starts_is_left_to_its_parent():
    """Property: the process, which was sent SIGINT before it had imported anything, does its work."""
    with workers(divide=partial(divmod, 7, 2)) as pool:
        work = pool.submit({}, methodcaller("divide"))
        for child in multiprocessing.active_children():
            os.kill(child.pid, signal.SIGINT)
        assert work.result() == (3, 1)
