"""Source of truth: what the operating system does to a process, and what is left to say of it."""

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
    """What a process has answered that was sent SIGINT before it had imported anything, and the error of its pool.

    It is killed in the end: SIGKILL, as a system that runs out of memory sends it.
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


def test_of_a_worker_that_is_killed_one_line_is_said(ended):
    _, error = ended
    assert error.match("one was killed .*; run the same command again with fewer --workers")


def test_ctrl_c_while_a_worker_starts_is_left_to_its_parent(ended):
    answers, _ = ended
    assert answers == [(3, 1)]
