"""Which renderer works on this machine: each is probed by drawing a triangle in a subprocess.

Order: pyrender on EGL; pyrender on OSMesa; Embree ray casting, which needs nothing beyond the installed packages. A
library that is missing, a driver that crashes and a driver that draws nothing all show in the subprocess, and none of
them can crash the calling process.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass

__all__ = [
    "REMEDIES",
    "RENDERERS",
    "ProbeResult",
    "RendererError",
    "RendererInfo",
    "find_renderer",
    "probe",
    "probe_all",
]

RENDERERS: tuple[str, ...] = ("pyrender-egl", "pyrender-osmesa", "embree")
"""Names of the renderers, best first."""

REMEDIES = {
    "pyrender-egl": "apt-get install -y libegl1 libgl1",
    "pyrender-osmesa": "apt-get install -y libosmesa6 && pip install 'PyOpenGL>=3.1.7'",
    "embree": "pip install embreex",
}
"""The command that should make a renderer work on Debian and Ubuntu."""

_PROBE_SECONDS = 90.0


class RendererError(ValueError):
    """No renderer works, or the one that was named does not."""


@dataclass(frozen=True)
class RendererInfo:
    """A renderer that works here.

    Attributes:
        name: one of RENDERERS.
        detail: what draws, e.g. the OpenGL renderer and version.
        advice: what could be done to get a better one, one line each; empty when this is the best.
    """

    name: str
    detail: str
    advice: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProbeResult:
    """What came of trying one renderer.

    Attributes:
        name: one of RENDERERS.
        works: whether it drew the test picture right.
        message: what draws, or what went wrong, one line.
        remedy: the command that should fix it; empty when it works.
    """

    name: str
    works: bool
    message: str
    remedy: str


_cache: dict[str, ProbeResult] = {}


def probe(name: str) -> ProbeResult:
    """Try one of RENDERERS in a subprocess; a second call in this process answers from memory.

    Returns:
        The outcome. A renderer that does not work is an outcome, not an error.

    Raises:
        ValueError: if no renderer has that name.
    """
    if name not in RENDERERS:
        raise ValueError(f"renderer: expected one of {', '.join(RENDERERS)}, received {name!r}")
    if name not in _cache:
        _cache[name] = _run_probe(name)
    return _cache[name]


def probe_all() -> list[ProbeResult]:
    """Try every renderer, best first, for a report of what works here.

    Returns:
        One outcome for each of RENDERERS.
    """
    return [probe(name) for name in RENDERERS]


def find_renderer(prefer: str | None = None) -> RendererInfo:
    """Find the best renderer that works here. Each is tried once in a process; workers are told the name.

    Args:
        prefer: one of RENDERERS, which then must work, or None for the best that does; another is a ValueError.

    Returns:
        The renderer, with advice when a better one could be had.

    Raises:
        RendererError: if the renderer named, or every renderer, does not work; the message holds the remedy.
    """
    if prefer is not None:
        outcome = probe(prefer)
        if not outcome.works:
            raise RendererError(
                f"renderer {prefer!r}: expected it to draw a triangle, found: {outcome.message}. "
                f"Remedy: {outcome.remedy}, or choose another of {', '.join(RENDERERS)}"
            )
        return RendererInfo(prefer, outcome.message)
    failures: list[ProbeResult] = []
    for name in RENDERERS:
        outcome = probe(name)
        if outcome.works:
            return RendererInfo(name, outcome.message, tuple(_advice(failure) for failure in failures))
        failures.append(outcome)
    raise RendererError(
        f"no renderer works here ({'; '.join(f'{f.name}: {f.message}' for f in failures)}). "
        f"Remedy: {REMEDIES['pyrender-egl']}, or without root: {REMEDIES['embree']}"
    )


def _advice(failure: ProbeResult) -> str:
    return f"{failure.name} does not work here ({failure.message}); to get it: {failure.remedy}"


def _run_probe(name: str) -> ProbeResult:
    command = [sys.executable, "-m", "data_gen.rendering.probe_process", name]
    try:
        # The package may be imported from a folder that a fresh interpreter does not look in.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=_PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        message = f"no picture within {_PROBE_SECONDS:g} s"
        return ProbeResult(name, False, message, REMEDIES[name])
    lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
    if done.returncode == 0 and lines:
        return ProbeResult(name, True, lines[-1], "")
    errors = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    if done.returncode < 0:
        message = f"crashed with signal {-done.returncode}"
    else:
        message = errors[-1] if errors else f"exit code {done.returncode}"
    return ProbeResult(name, False, message, REMEDIES[name])
