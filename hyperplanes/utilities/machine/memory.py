"""Free memory, checked before large allocations."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["available_memory", "require_memory"]

UNCHECKED_BYTES = 2**30
"""Bytes below which nothing is checked."""


def available_memory() -> int | None:
    """Bytes available to this process without swapping, by machine and control group; None if unknown."""
    found = []
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        found += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
        group = Path("/sys/fs/cgroup")
        limit, used, kinds = ((group / f"memory.{name}").read_text().strip() for name in ("max", "current", "stat"))
        # cached files, which the kernel frees on demand
        cached = dict(line.split() for line in kinds.splitlines()).get("inactive_file", "0")
        found += [int(limit) - int(used) + int(cached)] if limit.isdigit() else []
    except (OSError, ValueError):
        pass
    if not found and hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    return min(found) if found else None


def require_memory(what: str, found: object, needed: float, remedy: str) -> None:
    """Refuse what does not fit into the free memory.

    Args:
        what: the argument that sets the size.
        found: its value.
        needed: approximate number of bytes.
        remedy: what to do.

    Raises:
        ValueError: it does not fit.
    """
    if needed <= UNCHECKED_BYTES or (free := available_memory()) is None or needed <= free:
        return
    raise ValueError(
        f"{what}: expected a size that fits into the {free / 1e9:.1f} GB of free memory, got {found}, which needs "
        f"{needed / 1e9:,.0f} GB; {remedy}"
    )
