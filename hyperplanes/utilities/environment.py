"""What a figure depends on beside the command: the commit, the machine, the versions."""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import subprocess
import tempfile
from pathlib import Path

__all__ = [
    "cache_folder",
    "environment",
    "find_commit",
    "find_processor",
    "has_amx",
    "has_bfloat16_products",
    "has_fast_bfloat16",
    "usable_cores",
]

ROOT = Path(__file__).resolve().parents[2]
RESULTS = "benchmarks/results"  # of a checkout


def cache_folder() -> Path:
    """Where programs of this user keep what may be deleted: `$XDG_CACHE_HOME`, `~/.cache`, or a temporary folder.

    A user whom the system does not know, as in a container started by number, may have no home.
    """
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"cache-of-{os.getuid()}"


def find_commit() -> str:
    """The commit of this code as `git describe --dirty` puts it, or the version of the installed package.

    Files of RESULTS that have changed are not counted: one benchmark writes them after the other.
    """
    from importlib.metadata import PackageNotFoundError, version

    def ask(*words: str) -> str:
        answer = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
        return answer.stdout.strip()

    try:
        if Path(ask("rev-parse", "--show-toplevel") or os.sep).resolve() == ROOT:
            changed = ask("diff", "--name-only", "HEAD", "--", ".", f":(exclude){RESULTS}")
            return (ask("describe", "--always") or "unknown") + ("-dirty" if changed else "")
    except OSError:  # no git here
        pass
    try:
        return f"version {version('hyperplanes')}"
    except PackageNotFoundError:
        return "unknown"


def find_processor() -> str:
    """The processor in words."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


@functools.cache
def has_amx() -> bool:
    """Whether this process may multiply matrices in bfloat16 by Intel's AMX: the CPU can, and Linux lets it."""
    return {"amx_bf16", "avx512_bf16"} <= _features() and _allow_tiles()


def _features() -> set[str]:
    """What Linux says of the processor, word by word: its vendor and flags among them."""
    try:
        return set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
    except OSError:  # no Linux
        return set()


def _allow_tiles() -> bool:
    """Ask Linux for the tile registers of AMX, for all threads of this process: those that did not ask have none."""
    arch_prctl, request, tile_data = 158, 0x1023, 18  # ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return ctypes.CDLL(None).syscall(arch_prctl, request, tile_data) == 0


def has_bfloat16_products() -> bool:
    """Whether AVX-512 multiplies numbers of bfloat16 faster than those of single precision.

    That is so on AMD's processors that have such instructions, as far as Linux tells; on Intel's it was not measured.
    """
    return {"AuthenticAMD", "avx512_bf16"} <= _features()


def has_fast_bfloat16() -> bool:
    """Whether PyTorch's convolutions and matrix products are faster in bfloat16 than in single precision on this CPU.

    That is so by AMX and where `has_bfloat16_products` (convolutions take 0.54 to 0.58 of the time on a Zen 4);
    `ONEDNN_MAX_CPU_ISA` may keep oneDNN from either.
    """
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "ALL").upper()
    unlimited = limit in ("ALL", "DEFAULT")
    if has_amx() and (unlimited or "AMX" in limit):
        return True
    by_avx512 = unlimited or limit.startswith(("AVX512_CORE_BF16", "AVX512_CORE_FP16", "AVX512_CORE_AMX", "AVX10"))
    return by_avx512 and has_bfloat16_products()


def usable_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def environment() -> dict[str, object]:
    """The commit, the processor and the versions, as they stand in the JSON files of results."""
    import torch

    return {
        "commit": find_commit(),
        "processor": find_processor(),
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
