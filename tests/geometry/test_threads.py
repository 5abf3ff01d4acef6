"""Source of truth: one thread. More threads, simultaneous calls and a forked process give the same results."""

import importlib
import os
import pkgutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from numba.core.dispatcher import Dispatcher

from hyperplanes.geometry import ImagePlanes, cameras, kernels
from hyperplanes.geometry.kernels import threads
from hyperplanes.geometry.kernels.threads import parallel_for, parallel_map, run_concurrently

PREFIX = "hyperplanes.geometry.kernels."


def lookups(count, size=8, exact=False):
    ours = cameras.pinhole(cameras.symmetric_intrinsics(size, size, 0.8), cameras.orbit(3, 2.5), size, size)
    images = torch.rand(3, 3, size, size, generator=torch.Generator().manual_seed(0))
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    return ImagePlanes(images, ours, exact=exact).lookup(points).colours


def test_parallel_for_covers_every_index_once():
    spans = parallel_for(lambda start, stop: (start, stop), 10_001, 37)
    assert [index for start, stop in spans for index in range(start, stop)] == list(range(10_001))
    assert max(stop - start for start, stop in spans) == 37
    assert parallel_for(lambda start, stop: 1, 0, 5) == []


@pytest.fixture
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_parts_of_parallel_map_use_one_thread_each_without_gradients_and_in_order(three_threads):
    weight = torch.ones(1, requires_grad=True)
    ran = []

    def work(part):
        ran.append((threading.get_ident(), torch.get_num_threads(), (weight * part).requires_grad))
        return 2 * part

    assert list(parallel_map(work, range(20))) == list(range(0, 40, 2))
    assert {state[1:] for state in ran} == {(1, False)}
    assert threading.get_ident() not in {state[0] for state in ran}
    assert torch.get_num_threads() == 3
    born = []  # a thread that starts afterwards has the number that was set
    thread = threading.Thread(target=lambda: born.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert born == [3]


def test_an_error_in_a_part_is_raised_and_later_parts_do_not_run(three_threads):
    ran = []

    def work(part):
        ran.append(part)
        time.sleep(1e-3)
        raise ValueError(f"part {part}")

    with pytest.raises(ValueError, match="part 0"):
        list(parallel_map(work, range(10_000)))
    assert len(ran) < 10_000


CPU = torch.device("cpu")


def test_two_computations_run_concurrently(three_threads):
    barrier = threading.Barrier(2, timeout=20)

    def work(name):
        barrier.wait()
        return name, sum(parallel_map(lambda part: part, range(5))), torch.is_grad_enabled()

    with torch.no_grad():
        assert run_concurrently(lambda: work("one"), lambda: work("other"), CPU) == (
            ("one", 10, False),
            ("other", 10, False),
        )


def test_two_computations_run_in_turn_with_one_thread_or_where_two_run_already(three_threads):
    def ran():
        return threading.get_ident()

    inner = run_concurrently(lambda: run_concurrently(ran, ran, CPU), ran, CPU)
    assert inner[0] == (ran(), ran())
    assert inner[1] != ran()
    assert run_concurrently(ran, ran, torch.device("meta")) == (ran(), ran())
    torch.set_num_threads(1)
    assert run_concurrently(ran, ran, CPU) == (ran(), ran())


@pytest.mark.parametrize("count", [2, 5, 3])
def test_both_of_two_computations_have_the_number_of_threads_that_is_set(count, three_threads):
    torch.set_num_threads(count)
    state = run_concurrently(*2 * [lambda: (torch.get_num_threads(), torch.is_grad_enabled())], CPU)
    assert state == ((count, False), (count, False))
    assert torch.get_num_threads() == count
    assert torch.is_grad_enabled()


@pytest.mark.parametrize("wrong", ["one", "other"])
def test_an_error_in_one_of_two_computations_is_raised_when_both_have_ended(wrong, three_threads):
    ended = []

    def work(name):
        time.sleep(0.0 if name == wrong else 0.05)
        ended.append(name)
        if name == wrong:
            raise ValueError(name)

    with pytest.raises(ValueError, match=wrong):
        run_concurrently(lambda: work("one"), lambda: work("other"), CPU)
    assert sorted(ended) == ["one", "other"]
    assert run_concurrently(lambda: 1, lambda: 2, CPU) == (1, 2)


@pytest.mark.parametrize(("size", "exact"), [(8, False), (8, True), (150, True)])
def test_the_result_does_not_depend_on_the_number_of_threads(size, exact):
    """Nor on how planes are read. At 150 x 150 pixels, one thread interleaves them for its points; three do not."""
    before = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results.append(lookups(20_000, size, exact))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(results[0], result) for result in results)


def test_all_functions_that_a_kernel_calls_are_inlined():
    """A function that is not inlined is bound to the kernel that was compiled or loaded first (numba 0.68).

    Cached machine code then gave other bits than newly compiled machine code.
    """
    names = [module.name for module in pkgutil.walk_packages(kernels.__path__, PREFIX)]
    modules = [vars(importlib.import_module(name)) for name in names if not name.endswith("_triton")]
    functions = [it for names in modules for it in names.values() if isinstance(it, Dispatcher)]
    assert functions
    assert all(function.targetoptions.get("forceinline") for function in functions)


def test_a_pool_is_made_once_even_if_several_threads_ask_at_once(monkeypatch):
    made = []

    def make(size, name):
        made.append(size)
        time.sleep(0.05)  # so that others ask meanwhile
        return object()

    monkeypatch.setattr(threads, "ThreadPoolExecutor", make)
    monkeypatch.setattr(threads, "_pools", {})
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(threads._pool, [3] * 4))
    assert made == [3]
    assert all(each is found[0] for each in found)


def test_lookups_from_several_threads_at_once():
    expected = lookups(9000)
    with ThreadPoolExecutor(4) as pool:
        assert all(torch.equal(expected, found) for found in pool.map(lookups, [9000] * 8))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork.*:DeprecationWarning")
def test_lookups_after_a_fork():
    """The child uses one thread for PyTorch's operators, as PyTorch's data loaders do; otherwise they hang."""
    expected = lookups(9000)
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        torch.set_num_threads(1)
        same = torch.equal(lookups(9000), expected)
        os._exit(0 if same and threads._pool(1).submit(int).result() == 0 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
