"""Durations, rates and counts as text."""

from __future__ import annotations

__all__ = ["counted", "format_duration", "format_rate"]


def format_duration(seconds: float) -> str:
    """A length of time with its unit.

    >>> [format_duration(seconds) for seconds in (0.034, 0.9996, 8.25, 59.96, 75, 7322)]
    ['34 ms', '1.0 s', '8.2 s', '1 min 00 s', '1 min 15 s', '2 h 02 min']
    """
    if round(1000 * seconds) < 1000:
        return f"{1000 * seconds:.0f} ms"
    if round(10 * seconds) < 600:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def format_rate(value: float) -> str:
    """A large number in thousands or millions.

    >>> [format_rate(value) for value in (950, 999.6, 12345, 999_960, 2.5e6)]
    ['950', '1.0k', '12.3k', '1.0M', '2.5M']
    """
    if value < 999.5:
        return f"{value:.0f}"
    if value < 999_950:
        return f"{value / 1e3:.1f}k"
    return f"{value / 1e6:.1f}M"


def counted(count: int, noun: str) -> str:
    """A number and its noun.

    >>> counted(1, "view"), counted(3, "view")
    ('1 view', '3 views')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
