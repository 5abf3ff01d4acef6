"""Ctrl-C, SIGTERM and SIGHUP as exceptions that end a command at any point."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

__all__ = ["SIGNALS", "HungUp", "Terminated", "interrupt_behind", "interruptible", "keep_handlers", "listened_to"]

AGAIN_SECONDS = 0.2
"""Seconds after which a swallowed interrupt is raised again."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, from `kill` or a cluster: ends a command like Ctrl-C, with another exit code."""

    code = 128 + signal.SIGTERM


class HungUp(Terminated):
    """SIGHUP, from a closed terminal: likewise."""

    code = 128 + signal.SIGHUP


SIGNALS: dict[int, type[KeyboardInterrupt]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
    signal.SIGHUP: HungUp,
}
"""What each signal raises."""


def listened_to() -> list[int]:
    """The SIGNALS that are not ignored: `nohup` ignores one, a shell without job control another."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def interruptible() -> Generator[None]:
    """SIGINT raises KeyboardInterrupt, SIGTERM `Terminated` and SIGHUP `HungUp` within, until the exception leaves it.

    Once is not enough: an exception in Python code that native code calls (the compiler, the garbage collector) is
    printed and lost. So a timer raises it again, except during clean-up code that passes it on. Ignored signals and
    threads other than the main one, which receive no signals, are unaffected.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[type[KeyboardInterrupt]] = []

    def note(number: int, _: object) -> None:
        heard.append(SIGNALS[number])
        before.setdefault(signal.SIGALRM, signal.signal(signal.SIGALRM, again))
        signal.setitimer(signal.ITIMER_REAL, AGAIN_SECONDS, AGAIN_SECONDS)
        raise heard[-1]

    def again(*_: object) -> None:
        if not _is_passed_on():
            raise heard[-1]

    def report(unraisable: sys.UnraisableHookArgs) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            hook(unraisable)

    hook = sys.unraisablehook
    before: dict[int, Any] = {}
    for number in listened_to():
        before[number] = signal.signal(number, note)
    sys.unraisablehook = report
    try:
        yield
    finally:
        if heard:
            signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def keep_handlers() -> Generator[None]:
    """Restore Python's handlers of SIGNALS afterwards, if native code has replaced them.

    `signal.getsignal` does not show that. Importing pycolmap replaces them (glog prints a stack trace for SIGTERM).
    Only the main thread can restore them.
    """
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if (handler := signal.getsignal(number)) is not None:
                    signal.signal(number, handler)


def interrupt_behind(error: BaseException | None) -> BaseException | None:
    """The interrupt, or GeneratorExit, that an exception is or was raised in response to; None for others.

    >>> try:
    ...     try:
    ...         raise KeyboardInterrupt
    ...     except KeyboardInterrupt:
    ...         raise ValueError
    ... except ValueError as error:
    ...     interrupt_behind(error)
    KeyboardInterrupt()
    """
    while error is not None and not isinstance(error, KeyboardInterrupt | GeneratorExit):
        error = error.__context__
    return error


def _is_passed_on() -> bool:
    """Whether the main thread handles an interrupt in a `finally` or `except`, or closes a generator."""
    return interrupt_behind(sys.exception()) is not None
