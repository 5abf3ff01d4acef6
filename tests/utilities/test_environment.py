"""Source of truth: git in the folder of the project; outside of a checkout, the version of the package."""

import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from hyperplanes.utilities.machine import environment
from hyperplanes.utilities.machine.environment import RESULTS, find_commit, has_amx, has_fast_bfloat16

ROOT = Path(__file__).resolve().parents[2]


def git(folder, *words):
    return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=False).stdout.strip()


def test_the_commit_is_that_of_this_checkout():
    commit = git(ROOT, "describe", "--always") if (ROOT / ".git").exists() else f"version {version('hyperplanes')}"
    assert find_commit().removesuffix("-dirty") == commit


def test_changed_code_makes_the_commit_dirty_and_changed_results_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr(environment, "ROOT", tmp_path.resolve())
    files = [tmp_path / "code.py", tmp_path / RESULTS / "rows.json"]
    files[1].parent.mkdir(parents=True)
    for file in files:
        file.write_text("1")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first")
    commit = git(tmp_path, "describe", "--always", "--dirty")
    assert len(commit) >= 7
    assert find_commit() == commit
    files[1].write_text("2")
    assert find_commit() == commit
    files[0].write_text("2")
    assert find_commit() == git(tmp_path, "describe", "--always", "--dirty") == f"{commit}-dirty"


@pytest.mark.parametrize(
    ("flags", "allowed", "expected"),
    [
        ("avx512_bf16 amx_bf16 amx_tile", True, True),
        ("avx512_bf16 amx_bf16", False, False),
        ("avx512_bf16", True, False),
        (None, True, False),
    ],
)
def test_amx_is_used_if_the_processor_has_it_and_linux_allows_it(monkeypatch, flags, allowed, expected):
    def read_text(path, encoding):
        if flags is None:
            raise FileNotFoundError
        return f"flags : fpu {flags} sse"

    monkeypatch.setattr(Path, "read_text", read_text)
    monkeypatch.setattr(environment, "_allow_tiles", lambda: allowed)
    assert has_amx.__wrapped__() is expected


@pytest.mark.parametrize(
    ("limit", "amx", "processor", "expected"),
    [
        (None, True, "GenuineIntel avx512_bf16", True),
        ("avx512_core_amx", True, "GenuineIntel avx512_bf16", True),
        ("AVX512_CORE_BF16", True, "GenuineIntel avx512_bf16", False),
        (None, False, "GenuineIntel avx512_bf16", False),
        (None, False, "AuthenticAMD avx512_bf16", True),
        ("AVX512_CORE_BF16", False, "AuthenticAMD avx512_bf16", True),
        ("AVX512_CORE_FP16", False, "AuthenticAMD avx512_bf16", True),
        ("AVX512_CORE_AMX", False, "AuthenticAMD avx512_bf16", True),
        ("AVX10_1_512", False, "AuthenticAMD avx512_bf16", True),
        ("AVX512_CORE_VNNI", False, "AuthenticAMD avx512_bf16", False),
        (None, False, "AuthenticAMD avx512f", False),
    ],
)
def test_bfloat16_is_fast_if_onednn_may_use_its_instructions(monkeypatch, limit, amx, processor, expected):
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    if limit:
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", limit)
    monkeypatch.setattr(environment, "has_amx", lambda: amx)
    monkeypatch.setattr(environment, "_features", lambda: set(processor.split()))
    assert has_fast_bfloat16() is expected
