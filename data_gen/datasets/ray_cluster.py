"""The same work on a Ray cluster: one actor a renderer, an actor's death costs one item. Ray is optional.

Every machine of the cluster needs this package and the folder of the data set (a shared file system). A cluster is
found through RAY_ADDRESS; without it Ray starts on this machine alone, and ends with the work.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from data_gen.datasets.worker_process import answer
from data_gen.datasets.workers import ATTEMPTS, START_SECONDS, Outcome, WorkerError

__all__ = ["run_on_ray"]


class _Renderer:
    """What an actor holds: the opened target."""

    def __init__(self, target: str, settings: dict[str, Any]) -> None:
        module, _, function = target.partition(":")
        self._context = getattr(import_module(module), function)(settings)
        self._process = self._context.__enter__()

    def answer(self, item: dict[str, Any]) -> dict[str, Any]:
        return answer(self._process, item)


def run_on_ray(
    target: str,
    settings: dict[str, Any],
    items: Iterable[dict[str, Any]],
    *,
    workers: int | None,
    timeout: float = 300.0,
    recycle: int = 200,
) -> Generator[Outcome, None, None]:
    """Do items in Ray actors, as they come; `data_gen.datasets.workers.run_isolated` with the cluster's processors.

    Args:
        target: "module:function", importable on every machine.
        settings: JSON-able.
        items: JSON-able; taken one by one, when an actor is free.
        workers: how many actors; one a processor of the cluster when None.
        timeout: seconds that an item may take before its actor is killed.
        recycle: items after which an actor is replaced by a new one.

    Yields:
        One outcome an item, in the order in which they end. WorkerError comes out of it when an actor reports that
        nothing can be done.

    Raises:
        ValueError: ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError("engine: expected ray to be installed, found no such module; pip install ray") from error
    started = not ray.is_initialized()
    if started:
        _start(ray, workers)
    try:
        count = workers or int(ray.cluster_resources().get("CPU", 1))
        yield from _run(ray, target, settings, iter(items), count, timeout, recycle)
    finally:
        if started:
            ray.shutdown()


def _start(ray: Any, workers: int | None) -> None:
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {"PYTHONPATH": path, "LP_NUM_THREADS": "0", "OMP_NUM_THREADS": "1"}
    options: dict[str, Any] = {"log_to_driver": False, "runtime_env": {"env_vars": environment}}
    if "RAY_ADDRESS" not in os.environ:
        options |= {"include_dashboard": False, "num_cpus": workers or len(os.sched_getaffinity(0))}
    ray.init(**options)


def _run(
    ray: Any,
    target: str,
    settings: dict[str, Any],
    pending: Iterator[dict[str, Any]],
    count: int,
    timeout: float,
    recycle: int,
) -> Generator[Outcome, None, None]:
    make = ray.remote(num_cpus=1, max_restarts=0)(_Renderer)
    idle: list[tuple[Any, int]] = []  # actors, and how many items each may still do
    again: deque[tuple[dict[str, Any], int]] = deque()
    running: dict[Any, tuple[Any, int, dict[str, Any], int, float]] = {}
    while True:
        while len(running) < count:
            entry = again.popleft() if again else next(((item, 1) for item in pending), None)
            if entry is None:
                break
            fresh = not idle
            actor, left = (make.remote(target, settings), recycle) if fresh else idle.pop()
            deadline = time.monotonic() + timeout + (START_SECONDS if fresh else 0.0)
            running[actor.answer.remote(entry[0])] = (actor, left - 1, *entry, deadline)
        if not running:
            return
        soonest = min(state[-1] for state in running.values()) - time.monotonic()
        ready, _ = ray.wait(list(running), num_returns=1, timeout=max(0.0, soonest))
        late = [future for future, state in running.items() if state[-1] <= time.monotonic() and future not in ready]
        for future in [*ready, *late]:
            actor, left, item, attempt, _ = running.pop(future)
            reply: dict[str, Any] = (
                {"lost": f"no answer within {timeout:g} s"} if future in late else _reply(ray, future)
            )
            if "fatal" in reply:
                raise WorkerError(reply["fatal"])
            if "lost" not in reply:
                if left > 0:
                    idle.append((actor, left))
                result, reason = reply.get("ok"), reply.get("skip")
                yield Outcome(item, result, reason)
                continue
            ray.kill(actor)
            if attempt < ATTEMPTS:
                again.append((item, attempt + 1))
            else:
                yield Outcome(item, None, f"failed {attempt} times: {reply['lost']}")


def _reply(ray: Any, future: Any) -> dict[str, Any]:
    """An actor's answer; one that died in its first breath reports why, for no item can be done then."""
    try:
        return ray.get(future)
    except ray.exceptions.ActorDiedError as error:
        cause = getattr(error, "cause", None) or getattr(error, "error_msg", "")
        if "creation task" in str(error) and "Error" in str(error):
            return {"fatal": " ".join(str(cause or error).split())[-300:]}
        return {"lost": "its actor died"}
    except ray.exceptions.RayError as error:
        return {"lost": f"{type(error).__name__}"}
