"""A pool of worker processes that may crash, hang or be killed, each at the cost of one item.

Workers are started as commands (`python -m data_gen.datasets.worker_process`), not forked or spawned by
multiprocessing: OpenGL does not survive a fork, and calling scripts need no `if __name__ == "__main__"`.
concurrent.futures would also lose other items when a process crashes, and has no time limit per item.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, Protocol

__all__ = [
    "Outcome",
    "Worker",
    "WorkerError",
    "WorkerLost",
    "WorkerTimeout",
    "run_isolated",
    "run_workers",
    "worker_environment",
]

MAX_ATTEMPTS = 2
"""How often an item is tried if its worker crashes."""

START_SECONDS = 120.0
"""Time that a worker has to start, in addition to that of its first item."""


class WorkerError(RuntimeError):
    """No item can be processed: the workers do not start, or report an error that is not due to an item."""


class WorkerLost(Exception):
    """A worker crashed or was too slow, as the message says."""


class WorkerTimeout(WorkerLost):
    """A worker was too slow. Its item is not tried again."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of an item.

    Attributes:
        item: the item.
        result: the worker's answer; None if the item was skipped.
        reason: why it was skipped; None if it was not.
    """

    item: dict[str, Any]
    result: dict[str, Any] | None
    reason: str | None


class Worker(Protocol):
    """Processes one item after the other."""

    def process(self, item: dict[str, Any]) -> dict[str, Any]:
        """The answer of `worker_process.process_item`; WorkerLost if there is none."""
        ...

    def kill(self) -> None:
        """End it at once, from any thread; `process` then raises WorkerLost."""
        ...

    def stop(self) -> None:
        """End it after its last item, and free its resources."""
        ...


def worker_environment() -> dict[str, str]:
    """Environment variables of a worker, which imports this package from here and uses one core."""
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return {"PYTHONPATH": path, "LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def run_isolated(
    target: str,
    settings: dict[str, Any],
    items: Iterable[dict[str, Any]],
    *,
    workers: int,
    timeout: float,
    recycle: int,
) -> Generator[Outcome, None, None]:
    """Process items in worker processes of this machine.

    Args:
        target: "module:function"; called with the settings, it returns a function of an item.
        settings: JSON-able.
        items: JSON-able; taken one by one, when a worker is free.
        workers: number of processes.
        timeout: seconds that an item may take before its worker is killed.
        recycle: items after which a worker is replaced by a new one.

    Yields:
        What `run_workers` yields.
    """
    yield from run_workers(lambda: _ProcessWorker(target, settings, timeout), items, workers, recycle)


def run_workers(
    make_worker: Callable[[], Worker], items: Iterable[dict[str, Any]], count: int, recycle: int
) -> Generator[Outcome, None, None]:
    """Process items in workers, each driven by a thread; errors of the threads are raised here.

    Args:
        make_worker: makes a worker.
        items: taken one by one, when a worker is free.
        count: number of workers.
        recycle: items after which a worker is replaced by a new one.

    Yields:
        One outcome per item, in order of completion. Leaving the loop kills the workers. WorkerError is raised when a
        worker reports that no item can be processed.

    Raises:
        ValueError: fewer than one worker.
    """
    if count < 1:
        raise ValueError(f"workers: expected at least 1, got {count}")
    pending, lock, stopping = iter(items), threading.Lock(), threading.Event()
    free = threading.Semaphore(count)  # items are taken only after earlier outcomes have been handled
    ended: SimpleQueue[Outcome | Exception | None] = SimpleQueue()
    alive: set[Worker] = set()

    def open_worker() -> Worker:
        with lock:
            if stopping.is_set():
                raise WorkerLost("stopped")
            worker = make_worker()
            alive.add(worker)
            return worker

    def close_worker(worker: Worker) -> None:
        worker.stop()
        with lock:
            alive.discard(worker)

    def serve() -> None:
        current = _Current(open_worker, close_worker, recycle)
        try:
            while free.acquire() and not stopping.is_set():
                with lock:
                    item = next(pending, None)
                if item is None:
                    break
                answer = current.process(item)
                ended.put(Outcome(item, answer.get("ok"), answer.get("skip")))
        except Exception as error:
            ended.put(error)
        finally:
            free.release()  # for the other threads, which must also see the end of the items
            current.close(kill=stopping.is_set())
            ended.put(None)

    threads = [threading.Thread(target=serve, daemon=True) for _ in range(count)]
    try:
        for thread in threads:
            thread.start()
        running = count
        while running:
            outcome = ended.get()
            if outcome is None:
                running -= 1
            elif isinstance(outcome, Exception):
                raise outcome
            else:
                yield outcome
                free.release()
    finally:
        stopping.set()
        with lock:
            for worker in alive:
                worker.kill()
        free.release(count)
        for thread in threads:
            thread.join()


class _Current:
    """The worker of a thread, replaced by a new one when it is lost or has processed `recycle` items."""

    def __init__(self, open_worker: Callable[[], Worker], close_worker: Callable[[Worker], None], recycle: int) -> None:
        self._open, self._close, self._recycle = open_worker, close_worker, recycle
        self._worker: Worker | None = None
        self._left = 0

    def process(self, item: dict[str, Any]) -> dict[str, Any]:
        answer = self._answer(item)
        if "fatal" in answer:
            raise WorkerError(answer["fatal"])
        self._left -= 1
        if self._left <= 0:
            self.close(kill=False)
        return answer

    def _answer(self, item: dict[str, Any]) -> dict[str, Any]:
        answer: dict[str, Any] = {}
        for attempt in range(1, MAX_ATTEMPTS + 1):
            if self._worker is None:
                self._worker, self._left = self._open(), self._recycle
            try:
                return self._worker.process(item)
            except WorkerLost as error:
                self.close(kill=True)
                if isinstance(error, WorkerTimeout):
                    return {"skip": f"{error}; simplify it, or allow more by --timeout"}
                answer = {"skip": f"failed {attempt} times: {error}"}
        return answer

    def close(self, *, kill: bool) -> None:
        if self._worker is not None:
            if kill:
                self._worker.kill()
            self._close(self._worker)
            self._worker = None


class _ProcessWorker:
    """A process that is sent one item at a time."""

    def __init__(self, target: str, settings: dict[str, Any], timeout: float) -> None:
        self._log: IO[bytes] = tempfile.TemporaryFile()
        self._timeout, self._started, self._buffer = timeout, False, b""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "data_gen.datasets.worker_process", target],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env={**os.environ, **worker_environment()},
            start_new_session=True,  # Ctrl-C reaches only the parent, which then ends its workers
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._items, self._answers = self._process.stdin, self._process.stdout
        self._send(settings)

    def process(self, item: dict[str, Any]) -> dict[str, Any]:
        self._send(item)
        deadline = time.monotonic() + self._timeout + (0.0 if self._started else START_SECONDS)
        while True:
            while b"\n" not in self._buffer:
                if not select.select([self._answers], [], [], max(0.0, deadline - time.monotonic()))[0]:
                    raise WorkerTimeout(f"expected to be done within {self._timeout:g} s, found no answer")
                data = os.read(self._answers.fileno(), 1 << 20)
                if not data:
                    raise WorkerLost(f"its worker {self._end()}")
                self._buffer += data
            line, _, self._buffer = self._buffer.partition(b"\n")
            answer = json.loads(line)
            if "ready" not in answer:
                return answer
            self._started, deadline = True, time.monotonic() + self._timeout

    def kill(self) -> None:
        self._process.kill()

    def stop(self) -> None:
        for pipe in (self._items, self._answers):
            try:
                pipe.close()
            except BrokenPipeError:
                pass
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def _end(self) -> str:
        try:
            code = self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            return "closed its output"
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        self._log.seek(0)
        lines = self._log.read()[-2000:].decode(errors="replace").strip().splitlines()
        return f"ended with exit code {code}{': ' + lines[-1] if lines else ''}"

    def _send(self, value: dict[str, Any]) -> None:
        try:
            self._items.write(json.dumps(value).encode() + b"\n")
            self._items.flush()
        except BrokenPipeError:  # it has ended already; reading its answer reports that
            pass
