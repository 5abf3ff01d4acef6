"""Starts one process per device with Lightning Fabric, or joins those that torchrun has started.

Both set the same environment variables.
"""

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

DISTRIBUTED_TIMEOUT = timedelta(hours=6)
"""How long a process waits for another one, for example while the first one validates."""

GRACE = 5.0
"""Seconds that the processes started here have to end by themselves after an error in this process."""


def count_processes(devices: int, nodes: int) -> tuple[int, int]:
    """The number of processes per node and the number of nodes. If torchrun started this process, it decides both.

    Args:
        devices: the requested number of processes on each node.
        nodes: the requested number of nodes.

    Returns:
        Processes per node, and nodes.

    Raises:
        ValueError: a number below one, other numbers than torchrun has started, or several nodes without MASTER_ADDR,
            MASTER_PORT and NODE_RANK in the environment.
    """
    for name, count in (("--devices", devices), ("--nodes", nodes)):
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    if distributed.is_available() and distributed.is_torchelastic_launched():
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
    """A context in which this process is one of a group of torch.distributed.

    If nothing else has started the other processes of this node, this process starts them: each runs the same command,
    with LOCAL_RANK in its environment.

    Args:
        devices: processes per node, from `count_processes`.
        nodes: the number of nodes.
        device: a device of the type on which each process computes.

    Yields:
        The device of this process.

    Raises:
        ValueError: a device with an index for several processes, or fewer GPUs than processes on this node.
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
            "--device cpu allows any number of processes"
        )
    from lightning_fabric import Fabric
    from lightning_fabric.strategies import DDPStrategy

    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    strategy = DDPStrategy(timeout=DISTRIBUTED_TIMEOUT)
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
    """Leave the group after an error, because an interpreter that ends while gloo's threads run is sometimes aborted.

    After another process was killed, 6 of 36 processes were aborted; of 36 that left the group, none was (PyTorch 2.13,
    two cores). Collectives are synchronous, so none is running. With NCCL the group is not left, because NCCL may wait
    for a process that has ended.
    """
    if distributed.is_initialized() and distributed.get_backend() == "gloo":
        distributed.destroy_process_group()


def _end(started: Iterable[subprocess.Popen[bytes]]) -> None:
    """Kill the processes that have not ended after GRACE seconds."""
    deadline = time.monotonic() + GRACE
    for process in started:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))
        if process.poll() is None:
            process.kill()
