"""What a result depends on beside the command: the commit, the machine, the versions."""

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

ROOT = Path(__file__).resolve().parents[3]
RESULTS = "benchmarks/results"  # in a checkout


def cache_folder() -> Path:
    """This user's cache folder: `$XDG_CACHE_HOME`, `~/.cache`, or a temporary folder.

    A user without an entry in the system, as in a container started with a numeric user, may have no home.
    """
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"cache-of-{os.getuid()}"


def find_commit() -> str:
    """The commit of this code as `git describe --dirty` puts it, or the version of the installed package.

    Changed files in RESULTS are ignored: benchmarks write them one after the other.
    """
    from importlib.metadata import PackageNotFoundError, version

    def ask(*words: str) -> str:
        answer = subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, errors="surrogateescape", check=False
        )
        return answer.stdout.strip()

    try:
        if Path(ask("rev-parse", "--show-toplevel") or os.sep).resolve() == ROOT:
            changed = ask("diff", "--name-only", "HEAD", "--", ".", f":(exclude){RESULTS}")
            return (ask("describe", "--always") or "unknown") + ("-dirty" if changed else "")
    except OSError:  # no git
        pass
    try:
        return f"version {version('hyperplanes')}"
    except PackageNotFoundError:
        return "unknown"


def find_processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


@functools.cache
def has_amx() -> bool:
    """Whether the CPU has Intel's AMX for bfloat16, and Linux lets this process use it."""
    return {"amx_bf16", "avx512_bf16"} <= _features() and _allow_tiles()


def _features() -> set[str]:
    """Linux' description of the processor as words, such as its vendor and flags."""
    try:
        return set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
    except OSError:  # not Linux
        return set()


def _allow_tiles() -> bool:
    """Ask Linux for the tile registers of AMX for all threads of this process; otherwise there are none."""
    arch_prctl, request, tile_data = 158, 0x1023, 18  # ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return ctypes.CDLL(None).syscall(arch_prctl, request, tile_data) == 0


def has_bfloat16_products() -> bool:
    """Whether AVX-512 multiplies bfloat16 faster than single precision.

    True on AMD processors for which Linux reports the instructions; not measured on Intel's.
    """
    return {"AuthenticAMD", "avx512_bf16"} <= _features()


def has_fast_bfloat16() -> bool:
    """Whether PyTorch's convolutions and matrix products are faster in bfloat16 than in single precision on this CPU.

    True with AMX and where `has_bfloat16_products` (convolutions take 0.54 to 0.58 of the time on a Zen 4);
    `ONEDNN_MAX_CPU_ISA` may forbid both to oneDNN.
    """
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "ALL").upper()
    unlimited = limit in ("ALL", "DEFAULT")
    if has_amx() and (unlimited or "AMX" in limit):
        return True
    by_avx512 = unlimited or limit.startswith(("AVX512_CORE_BF16", "AVX512_CORE_FP16", "AVX512_CORE_AMX", "AVX10"))
    return by_avx512 and has_bfloat16_products()


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def environment() -> dict[str, object]:
    """The commit, the processor and the versions, for the JSON files of results."""
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
