"""One process a device, by Lightning Fabric or by torchrun, which sets the same environment variables."""

from __future__ import annotations

import logging
import os
import subprocess
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from datetime import timedelta

import torch
from torch import distributed

__all__ = ["count_processes", "launched"]

PATIENCE = timedelta(hours=6)
"""How long a process waits for another one, such as for the first one's validation."""

GRACE = 5.0
"""Seconds in which the processes that were started here may end by themselves, once this one has ended in an error."""


def _by_torchrun() -> bool:
    return distributed.is_available() and distributed.is_torchelastic_launched()


def count_processes(devices: int, nodes: int) -> tuple[int, int]:
    """Processes a node, and nodes: as torchrun says where it started this process, otherwise as asked for.

    Args:
        devices: asked for on each node.
        nodes: asked for.

    Returns:
        Both.

    Raises:
        ValueError: less than one, torchrun has started other numbers, or several nodes without a word on how they find
            each other.
    """
    for name, count in (("--devices", devices), ("--nodes", nodes)):
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    if _by_torchrun():
        local, total = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
        if (devices, nodes) not in ((1, 1), (local, total // local)):
            raise ValueError(
                f"--devices: expected the {local} processes on each of {total // local} nodes that torchrun has "
                f"started, got {devices} on each of {nodes}; leave out --devices and --nodes"
            )
        return local, total // local
    missing = [name for name in ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK") if name not in os.environ]
    if nodes > 1 and missing:
        raise ValueError(
            f"--nodes: expected MASTER_ADDR, MASTER_PORT and NODE_RANK (0 to {nodes - 1}) in the environment of every "
            f"node, got no {missing[0]}; set them, or start with torchrun"
        )
    return devices, nodes


@contextmanager
def launched(devices: int, nodes: int, device: torch.device) -> Generator[torch.device]:
    """The time in which torch.distributed joins as many processes, of which this is one.

    Where nothing else has started the others of this node, this process does: each is this command once more, with a
    LOCAL_RANK in its environment.

    Args:
        devices: processes a node, from `count_processes`.
        nodes: that take part.
        device: its kind is where each process computes.

    Yields:
        The device of this process.

    Raises:
        ValueError: fewer GPUs than processes on this node.
    """
    if devices * nodes == 1:
        yield device
        return
    if device.index is not None:
        raise ValueError(
            f"--device: expected cpu or cuda for several processes, got {device}; --devices takes the first GPUs"
        )
    if device.type == "cuda" and torch.cuda.device_count() < devices:
        raise ValueError(
            f"--devices: expected at most the {torch.cuda.device_count()} GPUs of this machine, got {devices}; "
            "--device cpu has as many processes as you like"
        )
    from lightning_fabric import Fabric
    from lightning_fabric.strategies import DDPStrategy

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    strategy = DDPStrategy(timeout=PATIENCE)
    fabric = Fabric(accelerator=device.type, devices=devices, num_nodes=nodes, strategy=strategy)
    try:
        fabric.launch()
        yield fabric.device
        distributed.destroy_process_group()
        for process in getattr(strategy.launcher, "procs", []):
            process.wait()
    finally:
        try:
            _leave()
        finally:
            _end(getattr(strategy.launcher, "procs", []))


def _leave() -> None:
    """Leave the group after an error: an interpreter that ends beside gloo's threads is aborted now and then.

    Of processes whose neighbour was killed 6 of 36 were, and none of 36 that left the group (PyTorch 2.13, two cores).
    Collectives are synchronous, so none is under way. NCCL is not asked, which may wait for a process that has gone.
    """
    if distributed.is_initialized() and distributed.get_backend() == "gloo":
        distributed.destroy_process_group()


def _end(started: Iterable[subprocess.Popen[bytes]]) -> None:
    """Kill what has not ended after some time."""
    deadline = time.monotonic() + GRACE
    for process in started:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))
        if process.poll() is None:
            process.kill()
