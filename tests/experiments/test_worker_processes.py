"""Source of truth: signals that the operating system sends to worker processes."""

import multiprocessing
import os
import signal
from functools import partial
from operator import methodcaller
from types import SimpleNamespace

import pytest

from hyperplanes.experiments.workers import Workers


@pytest.fixture(scope="module")
def ended():
    """The answers of a worker that got SIGINT before its imports, and the error of its pool.

    At the end the worker is killed by SIGKILL, as by a system that runs out of memory.
    """
    methods = {"divide": partial(divmod, 7, 2), "end": partial(signal.raise_signal, signal.SIGKILL)}
    pool = Workers(2, partial(SimpleNamespace, data=SimpleNamespace(generated={}), **methods))
    answers = []

    def work():
        with pool:
            answer = pool.submit({}, methodcaller("divide"))
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGINT)
            answers.append(answer.result())
            pool.submit({}, methodcaller("end")).result()

    with pytest.raises(ChildProcessError) as error:
        work()
    return answers, error


def test_a_killed_worker_is_reported_in_one_line(ended):
    _, error = ended
    assert error.match("one was killed .*; run the same command again with fewer --workers")


def test_a_starting_worker_ignores_ctrl_c(ended):
    answers, _ = ended
    assert answers == [(3, 1)]
