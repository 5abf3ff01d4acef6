"""The check that data_gen adds to `hyperplanes doctor`: a probe of each renderer."""

from __future__ import annotations

from hyperplanes.commands.checks import Check

__all__ = ["examine_renderers"]


def examine_renderers() -> list[Check]:
    """Draw a triangle with each renderer, each in a process of its own; one that works is enough.

    Returns:
        One outcome for all renderers, and one for each.
    """
    from data_gen.rendering.renderers import probe_all

    probes = probe_all()
    working = [probe for probe in probes if probe.works]
    best = f"{working[0].name} draws" if working else "none draws"
    summary = Check("renderer", bool(working), True, best, probes[0].remedy)
    return [
        summary,
        *(Check(f"renderer {each.name}", each.works, False, _reason(each.message), each.remedy) for each in probes),
    ]


def _reason(message: str) -> str:
    """A message without its exception class and its remedy, which is printed separately."""
    text = message.partition(" Remedy:")[0].rstrip(".")
    kind, found, rest = text.partition(": ")
    return rest if found and kind.endswith("Error") and " " not in kind else text
