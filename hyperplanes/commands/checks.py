"""Checks of what works on this machine, with a remedy for each problem."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from hyperplanes.utilities.entry_points import find_entries, load_entries
from hyperplanes.utilities.machine.environment import usable_cores
from hyperplanes.utilities.messages.formatting import counted

if TYPE_CHECKING:
    from packaging.requirements import Requirement

__all__ = ["Check", "examine", "healthy"]

OPTIONAL = {
    "tensorboard": ("watch", "train --tensorboard"),
    "ray": ("ray", "data generation on a cluster"),
    "DracoPy": ("draco", "meshes that Draco compressed"),
    "viser": ("viz", "view"),
    "imageio_ffmpeg": ("video", "turntables as MP4 and WebM, videos for capture"),
    "huggingface_hub": ("hub", "models on the Hugging Face hub"),
    "pycolmap": ("photos", "capture: the poses of photographs"),
    "onnxruntime": ("photos", "capture: masks by a network"),
    "cv2": ("photos", "capture: masks by colour"),
}
"""Modules of optional packages. For each: the extra that installs it, and what needs it."""

SMALLEST_FREE = 2 * 2**30

GROUP = "hyperplanes.checks"
"""The group of entry points of functions that return further checks, such as those of the renderers of data_gen."""


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: what was checked.
        works: whether it works.
        needed: whether `hyperplanes demo` cannot run without it.
        detail: what was found.
        remedy: what to do if it does not work, as one command if possible; empty if nothing is known.
    """

    name: str
    works: bool
    needed: bool
    detail: str
    remedy: str = ""


def healthy(checks: Sequence[Check]) -> bool:
    """Whether everything works that `hyperplanes demo` needs."""
    return all(check.works or not check.needed for check in checks)


def examine() -> list[Check]:
    """The results of all checks; Python, torch and the required packages come first."""
    checks = [_python(), _torch(), _packages()]
    if all(check.works for check in checks):
        checks += _lookups()
        found = load_entries(GROUP)
        for further in found.values():
            checks += further()
        lost = [entry.name for entry in find_entries(GROUP) if entry.name not in found]
        checks += [Check(f"checks {name}", False, False, "cannot be imported", "see the warning") for name in lost]
    return [*checks, _disk(Path()), *(_optional(module) for module in OPTIONAL)]


def _python() -> Check:
    found = ".".join(map(str, sys.version_info[:3]))
    remedy = "install Python 3.11 or newer and make the environment again"
    return Check("Python", sys.version_info >= (3, 11), True, found, remedy)


def _torch() -> Check:
    try:
        torch = import_module("torch")
        if float(torch.ones(2).sum()) != 2:
            return Check("torch", False, True, "computes wrong sums", "pip install --force-reinstall torch")
    except (ImportError, OSError, RuntimeError) as error:
        return Check("torch", False, True, _first_line(error), "pip install torch, or make a new environment")
    cores = usable_cores()
    where = f"CPU, {counted(torch.get_num_threads(), 'thread')} on {counted(cores, 'core')}"
    if torch.cuda.is_available():
        where = f"GPU {torch.cuda.get_device_name()}, and {where}"
    elif torch.version.cuda:
        where += f"; built for CUDA {torch.version.cuda}, which sees no GPU here"
    return Check("torch", True, True, f"{torch.__version__} on {where}")


def _packages() -> Check:
    from packaging.requirements import Requirement

    required = [Requirement(line) for line in requires("hyperplanes") or ()]
    here = [each for each in required if each.marker is None or each.marker.evaluate({"extra": ""})]
    unmet = [f"{each.name}{each.specifier}" for each in here if not _is_met(each)]
    if unmet:
        return Check(
            "packages", False, True, f"missing or too old: {', '.join(unmet)}", shlex.join(["pip", "install", *unmet])
        )
    return Check(
        "packages", True, True, ", ".join(f"{name} {version(name)}" for name in ("kornia", "trimesh", "numpy"))
    )


def _is_met(requirement: Requirement) -> bool:
    try:
        return requirement.specifier.contains(version(requirement.name), prereleases=True)
    except PackageNotFoundError:
        return False


def _lookups() -> list[Check]:
    from hyperplanes.geometry.lookup import backends

    remedies = {"cpu": "pip install numba", "triton": "an NVIDIA GPU with torch built for CUDA"}
    return [
        Check(f"lookup {found.name}", found.available, False, found.reason, remedies.get(found.name, ""))
        for found in backends()
    ]


def _disk(folder: Path) -> Check:
    free = shutil.disk_usage(folder).free
    detail = f"{free / 2**30:.1f} GiB free in {folder.resolve()}"
    return Check("disk", free > SMALLEST_FREE, False, detail, "free some space; a data set of 70 objects takes 20 MB")


def _optional(module: str) -> Check:
    extra, purpose = OPTIONAL[module]
    there = find_spec(module) is not None
    detail = f"{_version(module)}: {purpose}" if there else f"absent: {purpose}"
    return Check(module, there, False, detail, f"pip install 'hyperplanes[{extra}]'")


def _version(module: str) -> str:
    try:
        return version(module.replace("_", "-"))
    except PackageNotFoundError:
        return "installed"


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
