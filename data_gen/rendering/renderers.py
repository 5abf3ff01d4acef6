"""Which renderers work on this machine: each is probed by rendering a picture in a subprocess.

Order: pyrender on EGL; pyrender on OSMesa; Embree ray casting, which needs only the installed packages. The subprocess
reveals missing libraries, and drivers that crash or draw nothing, without harm to the calling process.
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
"""Commands that should make a renderer work on Debian and Ubuntu."""

_PROBE_SECONDS = 90.0


class RendererError(ValueError):
    """No renderer works, or the named one does not."""


@dataclass(frozen=True)
class RendererInfo:
    """A renderer that works here.

    Attributes:
        name: one of RENDERERS.
        detail: description, e.g. the OpenGL renderer and version.
        advice: how to get better ones, one line each; empty if this is the best.
    """

    name: str
    detail: str
    advice: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProbeResult:
    """The result of probing a renderer.

    Attributes:
        name: one of RENDERERS.
        works: whether it rendered the test picture correctly.
        message: its description, or the error, one line.
        remedy: the command that should fix it; empty if it works.
    """

    name: str
    works: bool
    message: str
    remedy: str


_cache: dict[str, ProbeResult] = {}


def probe(name: str) -> ProbeResult:
    """Probe one of RENDERERS in a subprocess; results are cached in this process.

    Returns:
        The result; a renderer that does not work is not an error.

    Raises:
        ValueError: if the name is unknown.
    """
    if name not in RENDERERS:
        raise ValueError(f"renderer: expected one of {', '.join(RENDERERS)}, got {name!r}")
    if name not in _cache:
        _cache[name] = _run_probe(name)
    return _cache[name]


def probe_all() -> list[ProbeResult]:
    """Probe every renderer, best first.

    Returns:
        One result for each of RENDERERS.
    """
    return [probe(name) for name in RENDERERS]


def find_renderer(prefer: str | None = None) -> RendererInfo:
    """Find the best renderer that works here. Each is probed once per process; workers are given the name.

    Args:
        prefer: one of RENDERERS, which must work, or None for the best that does; other names are a ValueError.

    Returns:
        The renderer, with advice on better ones.

    Raises:
        RendererError: if the named renderer, or every renderer, does not work; the message contains the remedy.
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
            command,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PROBE_SECONDS,
            check=False,
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
