"""Source of truth: the arguments with which `scripts/setup` calls a fake pip, which records them."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PYTORCH = "https://download.pytorch.org/whl/cpu"
PIP = """#!/bin/sh
echo "$*" >> "$ASKED"
case "$*" in
    *"$REACHED"*) exit 0 ;;
    *+cpu*) exit 1 ;;
esac
"""
PYTHON = """#!/bin/sh
[ "$1" = -m ] && echo "$2" >> "$ASKED.run"
[ "$1" != -c ]
"""  # a Python that cannot import torch


def script(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@pytest.mark.parametrize(
    ("reached", "gpu", "asked", "said"),
    [
        ("compile torch==N+cpu", False, ["torch==N+cpu"], "installed torch==N+cpu\n"),
        (PYTORCH, False, ["torch==N+cpu", PYTORCH], f"installed torch==N+cpu from {PYTORCH}\n"),
        ("nothing", False, ["torch==N+cpu", PYTORCH, "torch==N"], f"neither the package index nor {PYTORCH} offers"),
        ("nothing", True, ["torch==N"], "installing torch==N as the package index offers it\n"),
    ],
    ids=["from the index", "from PyTorch's index", "CUDA for want of it", "CUDA for a GPU"],
)
def test_setup_looks_for_the_cpu_build_of_torch_and_prints_what_it_installs(reached, gpu, asked, said, tmp_path):
    root, log = tmp_path / "project", tmp_path / "asked"
    script(root / "scripts/setup", (ROOT / "scripts/setup").read_text())
    shutil.copy(ROOT / "constraints.txt", root)
    torch = next(line for line in (root / "constraints.txt").read_text().splitlines() if line.startswith("torch=="))
    script(root / "venv/bin/pip", PIP)
    script(root / "venv/bin/python", PYTHON)
    script(tmp_path / "bin/nvidia-smi", f"#!/bin/sh\nexit {int(not gpu)}\n")
    script(tmp_path / "bin/ldconfig", "#!/bin/sh\necho libEGL.so.1 libGL.so.1 libXrender.so.1\n")
    environment = os.environ | {
        "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}",
        "ASKED": str(log),
        "REACHED": reached.replace("torch==N", torch),
    }
    done = subprocess.run(["scripts/setup", "venv"], cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *of_torch, of_kernels, package = log.read_text().splitlines()
    assert of_kernels == "install -q --no-compile -c constraints.txt jaxtyping kornia numba scipy"
    assert package == "install -q --no-compile -c constraints.txt -e ."
    assert Path(f"{log}.run").read_text() == "hyperplanes.geometry.kernels\n"
    assert len(of_torch) == len(asked)
    for call, expected in zip(of_torch, asked, strict=True):
        assert expected.replace("torch==N", torch) in call
        assert ("+cpu" in call) == (expected != "torch==N")
    assert said.replace("torch==N", torch) in done.stdout
    assert ("about 5 GB" in done.stdout) == (reached == "nothing" and not gpu)
