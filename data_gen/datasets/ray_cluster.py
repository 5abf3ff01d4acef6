"""The same work on a Ray cluster: one renderer per actor; an actor that dies costs one item. Ray is optional.

Every machine of the cluster needs this package and the folder of the data set (a shared file system). RAY_ADDRESS gives
the cluster; without it Ray starts on this machine alone, and ends with the work. Ray's ActorPool has no time limit per
item and ends with the first actor that dies.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable
from pkgutil import resolve_name
from typing import Any

from data_gen.datasets.worker_process import process_item
from data_gen.datasets.workers import START_SECONDS, Outcome, WorkerLost, WorkerTimeout, run_workers, worker_environment
from hyperplanes.utilities.machine.environment import usable_cores

__all__ = ["run_on_ray"]


def run_on_ray(
    target: str,
    settings: dict[str, Any],
    items: Iterable[dict[str, Any]],
    *,
    workers: int | None,
    timeout: float,
    recycle: int,
) -> Generator[Outcome, None, None]:
    """Process items in Ray actors: `data_gen.datasets.workers.run_isolated` with the cluster's processors.

    Args:
        target: "module:function", importable on every machine.
        settings: JSON-able.
        items: JSON-able; taken one by one, when an actor is free.
        workers: number of actors; one per processor of the cluster when None.
        timeout: seconds that an item may take before its actor is killed.
        recycle: items after which an actor is replaced by a new one.

    Yields:
        What `run_workers` yields.
    """
    import ray

    started = not ray.is_initialized()
    if started:
        options: dict[str, Any] = {"log_to_driver": False, "runtime_env": {"env_vars": worker_environment()}}
        if "RAY_ADDRESS" not in os.environ:
            options |= {"include_dashboard": False, "num_cpus": workers or usable_cores()}
        ray.init(**options)
    try:
        count = workers or int(ray.cluster_resources().get("CPU", 1))
        yield from run_workers(lambda: _RayWorker(ray, target, settings, timeout), items, count, recycle)
    finally:
        if started:
            ray.shutdown()


class _Actor:
    """An actor that holds the function returned by the target."""

    def __init__(self, target: str, settings: dict[str, Any]) -> None:
        self._process = resolve_name(target)(settings)

    def answer(self, item: dict[str, Any]) -> dict[str, Any]:
        return process_item(self._process, item)


class _RayWorker:
    """An actor that is sent one item at a time."""

    def __init__(self, ray: Any, target: str, settings: dict[str, Any], timeout: float) -> None:
        self._ray, self._timeout, self._left_to_start = ray, timeout, START_SECONDS
        self._actor = ray.remote(num_cpus=1, max_restarts=0)(_Actor).remote(target, settings)

    def process(self, item: dict[str, Any]) -> dict[str, Any]:
        errors = self._ray.exceptions
        try:
            reply = self._ray.get(self._actor.answer.remote(item), timeout=self._timeout + self._left_to_start)
        except errors.GetTimeoutError as error:
            raise WorkerTimeout(f"expected to be done within {self._timeout:g} s, found no answer") from error
        except errors.ActorDiedError as error:
            if "creation task" in str(error) and "Error" in str(error):  # it could not start, so no item can be done
                cause = getattr(error, "cause", None) or getattr(error, "error_msg", "")
                return {"fatal": " ".join(str(cause or error).split())[-300:]}
            raise WorkerLost("its actor died") from error
        except errors.RayError as error:
            raise WorkerLost(type(error).__name__) from error
        self._left_to_start = 0.0
        return reply

    def kill(self) -> None:
        self._ray.kill(self._actor)

    def stop(self) -> None:
        self._ray.kill(self._actor)
