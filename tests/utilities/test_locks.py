"""Source of truth: a forked process, which ends by itself unless a lock of the parent blocks it."""

import os
import signal
import threading
from contextlib import ExitStack

import pytest
import torch

from hyperplanes.adaptation import network
from hyperplanes.adaptation.correction import residuals
from hyperplanes.geometry.kernels import compiling
from hyperplanes.rendering import renderer
from hyperplanes.utilities.machine.locks import ForkSafeLock
from hyperplanes.utilities.tensors import seeding

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system"),
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork.*:DeprecationWarning"),
]
LOCKS = [seeding._alone, network._counting, renderer._counting, compiling._compiling, residuals._rendering]


def ends_in_a_child(work):
    """Whether a forked process completes some work within five seconds."""
    child = os.fork()
    if child == 0:
        signal.alarm(5)
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_a_child_does_not_wait_for_locks_that_other_threads_hold():
    held, end = threading.Event(), threading.Event()

    def hold():
        with ExitStack() as stack:
            for lock in LOCKS:
                stack.enter_context(lock)
            held.set()
            end.wait()

    def work():
        with seeding.seeded(0), network.in_use(torch.nn.Identity()), renderer.allow_tf32(torch.device("cuda")):
            pass
        with compiling._compiling, residuals._rendering:
            pass

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    try:
        assert ends_in_a_child(work)
        assert not LOCKS[0]._lock.acquire(blocking=False)  # the parent's lock stays held
    finally:
        end.set()
        thread.join()


def test_a_thread_that_forks_inside_a_lock_leaves_it_in_both_processes():
    lock = ForkSafeLock()

    def use():
        with lock:
            pass

    child = None
    with lock:
        child = os.fork()
        if child == 0:
            signal.alarm(5)
    if child == 0:
        thread = threading.Thread(target=use)
        thread.start()
        thread.join(2)
        os._exit(int(thread.is_alive()))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    use()
