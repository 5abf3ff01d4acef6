"""A pool of worker processes that may crash, hang or be killed, each at the cost of one item.

Workers are started as commands (`python -m data_gen.datasets.worker_process`), not forked and not spawned by
multiprocessing: OpenGL does not survive a fork, and a script that calls us needs no `if __name__ == "__main__"`.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

__all__ = ["Outcome", "WorkerError", "run_isolated"]

ATTEMPTS = 2
"""How often an item is tried whose worker crashes or hangs."""

START_SECONDS = 120.0


class WorkerError(RuntimeError):
    """No item can be processed: the workers do not start, or report an error that no item has caused."""


@dataclass(frozen=True)
class Outcome:
    """What became of an item.

    Attributes:
        item: the item.
        result: what the worker answered, None when it was skipped.
        reason: why it was skipped, None when it was not.
    """

    item: dict[str, Any]
    result: dict[str, Any] | None
    reason: str | None


def run_isolated(
    target: str,
    settings: dict[str, Any],
    items: Iterable[dict[str, Any]],
    *,
    workers: int,
    timeout: float = 300.0,
    recycle: int = 200,
) -> Generator[Outcome, None, None]:
    """Do items in worker processes, as they come.

    Args:
        target: "module:function"; called with the settings, it gives a context manager around a function of an item.
        settings: JSON-able.
        items: JSON-able; taken one by one, when a worker is free.
        workers: how many processes.
        timeout: seconds that an item may take before its worker is killed.
        recycle: items after which a worker is replaced by a new one.

    Yields:
        One outcome an item, in the order in which they end. Leaving the loop kills the workers. WorkerError comes
        out of it when a worker reports that nothing can be done.

    Raises:
        ValueError: fewer than one worker.
    """
    if workers < 1:
        raise ValueError(f"workers: expected at least 1, got {workers}")
    pool: list[_Worker] = []
    pending, again = iter(items), deque[tuple[dict[str, Any], int]]()
    selector = selectors.DefaultSelector()
    try:
        while True:
            while len(pool) < workers:
                entry = again.popleft() if again else _first(pending)
                if entry is None:
                    break
                worker = _Worker(target, settings, timeout, recycle)
                selector.register(worker.answers, selectors.EVENT_READ, worker)
                pool.append(worker)
                worker.give(*entry)
            if not pool:
                return
            soonest = min(worker.deadline for worker in pool) - time.monotonic()
            ready = {key.data for key, _ in selector.select(max(0.0, soonest))}
            for worker in list(pool):
                outcome, alive = worker.collect() if worker in ready else worker.check()
                if outcome is not None and outcome.result is None and not alive and worker.attempt < ATTEMPTS:
                    again.append((outcome.item, worker.attempt + 1))
                elif outcome is not None:
                    yield outcome
                if outcome is None and alive:
                    continue
                entry = None
                if alive and not worker.spent:
                    entry = again.popleft() if again else _first(pending)
                if entry is not None:
                    worker.give(*entry)
                else:
                    selector.unregister(worker.answers)
                    worker.stop(kill=not alive)
                    pool.remove(worker)
    finally:
        for worker in pool:
            worker.stop(kill=True)
        selector.close()


def _first(pending: Iterator[dict[str, Any]]) -> tuple[dict[str, Any], int] | None:
    item = next(pending, None)
    return None if item is None else (item, 1)


class _Worker:
    """One process, at work on one item at a time."""

    def __init__(self, target: str, settings: dict[str, Any], timeout: float, recycle: int) -> None:
        self.log: IO[bytes] = tempfile.TemporaryFile()
        self.timeout, self.left = timeout, recycle
        self.started = False
        self.item: dict[str, Any] = {}
        self.attempt = 0
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        threads = {"LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "data_gen.datasets.worker_process", target],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            env={**os.environ, **threads, "PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends its workers
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.items, self.answers = self.process.stdin, self.process.stdout
        self.buffer = b""
        self._send(settings)

    @property
    def spent(self) -> bool:
        return self.left <= 0

    def give(self, item: dict[str, Any], attempt: int) -> None:
        self.item, self.attempt = item, attempt
        self.left -= 1
        self.deadline = time.monotonic() + self.timeout + (0.0 if self.started else START_SECONDS)
        self._send(item)

    def collect(self) -> tuple[Outcome | None, bool]:
        """Read what has come; an outcome when the item is through, and whether the process can go on."""
        data = os.read(self.answers.fileno(), 1 << 20)
        if not data:
            return self._failed(f"its worker {self._end()}")
        self.buffer += data
        while b"\n" in self.buffer:
            line, _, self.buffer = self.buffer.partition(b"\n")
            answer = json.loads(line)
            if "fatal" in answer:
                raise WorkerError(answer["fatal"])
            if "ready" in answer:
                self.started = True
                self.deadline = time.monotonic() + self.timeout
                continue
            return Outcome(self.item, answer.get("ok"), answer.get("skip")), True
        return None, True

    def check(self) -> tuple[Outcome | None, bool]:
        """Nothing has come: has it taken too long?"""
        if time.monotonic() < self.deadline:
            return None, True
        return self._failed(f"no answer within {self.timeout:g} s")

    def stop(self, kill: bool) -> None:
        """End the process: by the end of its input, or at once."""
        if kill:
            self.process.kill()
        for pipe in (self.items, self.answers):
            try:
                pipe.close()
            except BrokenPipeError:
                pass
        try:
            self.process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.log.close()

    def _failed(self, reason: str) -> tuple[Outcome, bool]:
        self.process.kill()
        return Outcome(self.item, None, f"failed {self.attempt} times: {reason}"), False

    def _end(self) -> str:
        try:
            code = self.process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            return "closed its output"
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        self.log.seek(0)
        lines = self.log.read()[-2000:].decode(errors="replace").strip().splitlines()
        return f"ended with exit code {code}{': ' + lines[-1] if lines else ''}"

    def _send(self, value: dict[str, Any]) -> None:
        try:
            self.items.write(json.dumps(value).encode() + b"\n")
            self.items.flush()
        except BrokenPipeError:  # it has ended already, which shows when its answer is read
            pass
