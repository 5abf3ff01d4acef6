"""Ctrl-C, SIGTERM and SIGHUP as exceptions that end a command, wherever it is."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

__all__ = ["SIGNALS", "HungUp", "Terminated", "interrupt_behind", "interruptible", "keep_handlers", "listened_to"]

AGAIN_SECONDS = 0.2
"""After which an interrupt that was swallowed is raised again."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, as `kill` and clusters send it: ends a verb as Ctrl-C does, with another exit code."""

    code = 128 + signal.SIGTERM


class HungUp(Terminated):
    """SIGHUP, as a terminal sends it that is closed: likewise."""

    code = 128 + signal.SIGHUP


SIGNALS: dict[int, type[KeyboardInterrupt]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
    signal.SIGHUP: HungUp,
}
"""What each signal raises."""


def listened_to() -> list[int]:
    """Those of SIGNALS that are not ignored, as `nohup` ignores one and a shell without job control another."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def interruptible() -> Generator[None]:
    """SIGINT raises KeyboardInterrupt, SIGTERM `Terminated` and SIGHUP `HungUp` within, until the exception leaves it.

    Once is not enough: where native code calls Python (the compiler, the garbage collector), what is raised there is
    printed and lost. So a timer raises it again, except while it is being passed on through cleaning up. In threads
    other than the main one, which signals do not reach, nothing is changed, nor is a signal that is ignored.
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
    """Python's handlers of SIGNALS are in place again afterwards, whatever native code has put over them.

    Python does not see that: `signal.getsignal` goes on naming its own. The import of pycolmap does so (glog prints a
    stack trace for SIGTERM). Only the main thread can put them back.
    """
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if (handler := signal.getsignal(number)) is not None:
                    signal.signal(number, handler)


def interrupt_behind(error: BaseException | None) -> BaseException | None:
    """The interrupt, or the closing of a generator, that an exception is or was raised in answer to; None for others.

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
    """Whether the main thread is in a `finally` or `except` of an interrupt, or in that of a generator being closed."""
    return interrupt_behind(sys.exception()) is not None
