"""Source of truth: the known failure of each faulty item (faulty_worker.py), counted."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from data_gen.datasets.workers import WorkerError, run_isolated

HERE = Path(__file__).parent


@pytest.fixture
def run(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", str(HERE))

    def start(kinds, workers=2, timeout=20.0, recycle=200, broken=False):
        items = ({"name": str(index), "kind": kind} for index, kind in enumerate(kinds))
        settings = {"folder": str(tmp_path), "broken": broken}
        return run_isolated("faulty_worker:serve", settings, items, workers=workers, timeout=timeout, recycle=recycle)

    return start


def test_every_item_has_one_outcome_and_failures_affect_no_others(run):
    kinds = ["fine", "crash", "fine", "wrong", "exit", "bug", "once", "fine", "fine"]
    outcomes = {int(outcome.item["name"]): outcome for outcome in run(kinds)}
    assert sorted(outcomes) == list(range(len(kinds)))
    done = [index for index in outcomes if outcomes[index].result]
    assert done == [index for index in outcomes if kinds[index] in ("fine", "once")]
    assert outcomes[1].reason == "failed 2 times: its worker was ended by SIGSEGV"
    assert outcomes[3].reason == "nothing to draw in it"
    assert outcomes[4].reason == "failed 2 times: its worker ended with exit code 3: " + (
        "a library that prints to standard output"
    )
    assert outcomes[5].reason == "KeyError: 'colour'"


def test_a_hanging_worker_is_ended_and_the_others_continue(run):
    begun = time.monotonic()
    outcomes = {outcome.item["name"]: outcome for outcome in run(["hang", "fine", "fine"], timeout=0.5)}
    assert outcomes["0"].reason == (
        "expected to be done within 0.5 s, found no answer; simplify it, or allow more by --timeout"
    )
    assert outcomes["1"].result
    assert outcomes["2"].result
    assert time.monotonic() - begun < 60


def test_workers_are_recycled(run):
    processes = [outcome.result["process"] for outcome in run(["fine"] * 5, workers=1, recycle=2)]
    assert [processes.count(process) for process in dict.fromkeys(processes)] == [2, 2, 1]


def test_errors_that_do_not_belong_to_an_item_end_the_run(run):
    with pytest.raises(WorkerError, match="^disk is full$"):
        list(run(["full", "fine"]))
    with pytest.raises(WorkerError, match="^RuntimeError: no renderer here$"):
        list(run(["fine"], broken=True))
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        list(run(["fine"], workers=0))


def test_items_are_taken_as_workers_become_free(run):
    """Property: no more items are taken than there are outcomes and workers."""
    taken = []

    def kinds():
        for index in range(6):
            taken.append(index)
            yield "fine"

    for number, _ in enumerate(run(kinds(), workers=2), start=1):
        assert len(taken) <= number + 2


def test_leaving_the_loop_ends_the_workers(run):
    outcomes = run(["fine", "hang"], workers=2)
    process = next(outcomes).result["process"]
    outcomes.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_workers_end_when_their_parent_is_killed(tmp_path):
    script = (
        "from data_gen.datasets.workers import run_isolated\n"
        f"items = iter([dict(name='0', kind='fine')] * 10**6)\n"
        f"settings = dict(folder={str(tmp_path)!r})\n"
        "options = dict(workers=1, timeout=300, recycle=200)\n"
        "for o in run_isolated('faulty_worker:serve', settings, items, **options):\n"
        "    print(o.result['process'], flush=True)\n"
    )
    path = os.pathsep.join([str(HERE.parents[2]), str(HERE)])
    parent = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}
    )
    process = int(parent.stdout.readline())
    parent.kill()
    parent.stdout.close()
    parent.wait()
    for _ in range(100):
        try:
            os.kill(process, 0)
            if Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return  # ended, but not yet reaped by its new parent
        except (ProcessLookupError, FileNotFoundError):
            return
        time.sleep(0.1)
    raise AssertionError("the worker is still running")
