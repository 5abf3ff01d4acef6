"""Report what works on this machine: torch and its device, the renderers (each draws), lookups, optional packages.

The exit code is 0 if `hyperplanes demo` can run, even without the optional packages, and 1 if it cannot.

Example:
    hyperplanes doctor
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hyperplanes.commands.output.console import Console

if TYPE_CHECKING:
    from hyperplanes.commands.checks import Check

__all__ = ["Arguments", "line", "run"]


@dataclass(frozen=True)
class Arguments:
    """`doctor` has no options."""


def line(check: Check) -> str:
    """The line that is printed for a check."""
    mark = "ok    " if check.works else ("BROKEN" if check.needed else "-     ")
    remedy = "" if check.works or not check.remedy else f"; to fix it: {check.remedy}"
    return f"{mark}  {check.name:<26}{check.detail}{remedy}"


def run(arguments: Arguments) -> int:
    """Run all checks and print a line for each."""
    from hyperplanes.commands.checks import examine, healthy

    console, checks = Console(), examine()
    for check in checks:
        console.say(line(check))
    if healthy(checks):
        console.say("everything that `hyperplanes demo` needs works here")
        return 0
    broken = [check.name for check in checks if check.needed and not check.works]
    console.warn(f"`hyperplanes demo` cannot run here: {', '.join(broken)}; the remedies are above")
    return 1
