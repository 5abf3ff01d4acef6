"""Output of the verbs: lines, tables and progress lines, which a terminal redraws in place."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO, cast

from rich.console import Console as RichConsole
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table

__all__ = ["Bar", "Console"]

QUIET_SECONDS = 10.0
"""Least time between two progress lines if they are not redrawn in place."""


class Bar:
    """A progress line: a terminal redraws it in place; otherwise a new line is printed every QUIET_SECONDS."""

    def __init__(self, console: RichConsole, errors: RichConsole, progress: Progress | None, title: str) -> None:
        self._console, self._errors, self._progress, self._title = console, errors, progress, title
        self._task: TaskID | None = None
        self._printed = time.monotonic()

    def show(self, done: int, total: int, text: str, *, important: bool = False) -> None:
        """Update the progress line.

        Args:
            done: the amount of work that is done.
            total: the whole amount.
            text: what is shown after both numbers.
            important: print a line at once if nothing is redrawn in place.
        """
        if self._progress is not None:
            if self._task is None:
                self._task = self._progress.add_task(self._title, total=total, text=text)
            self._progress.update(self._task, completed=done, total=total, text=text)
        elif important or done == total or time.monotonic() - self._printed >= QUIET_SECONDS:
            self._printed = time.monotonic()
            self._console.print(f"{self._title} {done}/{total}  {text}", markup=False, highlight=False, soft_wrap=True)

    def warn(self, line: str) -> None:
        """Print a line on standard error, above the progress line."""
        _show(self._errors, line)


class _Terminal:
    """Standard output or error, which drops what is written after its terminal was closed.

    A training whose terminal is closed still has to write its checkpoint, so a progress line must not raise an error.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with _unless_closed():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with _unless_closed():
            self._stream.flush()


@contextmanager
def _unless_closed() -> Generator[None]:
    try:
        yield
    except OSError as error:
        if error.errno != errno.EIO:
            raise


class _Stream(RichConsole):
    """Rich's console, which raises BrokenPipeError for the caller to handle; Rich would exit with code 1."""

    def on_broken_pipe(self) -> None:
        raise


class Console:
    """Standard output for results, standard error for warnings.

    Args:
        silent: print nothing, as in all but the first process of a training.
        plain: redraw nothing in place, because several processes share the terminal.
    """

    def __init__(self, *, silent: bool = False, plain: bool = False) -> None:
        self._out = _Stream(file=cast(TextIO, _Terminal(sys.stdout)), quiet=silent)
        self._errors = _Stream(file=cast(TextIO, _Terminal(sys.stderr)), quiet=silent)
        self._live = self._out.is_terminal and not silent and not plain

    def say(self, line: str) -> None:
        """Print a line on standard output."""
        _show(self._out, line)

    def warn(self, line: str) -> None:
        """Print a line on standard error."""
        _show(self._errors, line)

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print a table; all columns but the first are aligned to the right."""
        if not self._live:
            widths = [max(len(row[i]) for row in [headings, *rows]) for i in range(len(headings))]
            for row in [headings, *rows]:
                first, *others = zip(row, widths, strict=True)
                cells = [f"{first[0]:<{first[1]}}", *(f"{cell:>{width}}" for cell, width in others)]
                self.say("  ".join(cells).rstrip())
            return
        table = Table(box=None, pad_edge=False, header_style="bold")
        for index, heading in enumerate(headings):
            table.add_column(heading, justify="right" if index else "left", no_wrap=index > 0)
        for row in rows:
            table.add_row(*row)
        self._out.print(table)

    @contextmanager
    def bar(self, title: str) -> Generator[Bar]:
        """A context with a progress line.

        Yields:
            The progress line.
        """
        if not self._live:
            yield Bar(self._out, self._errors, None, title)
            return
        columns = (
            TextColumn("{task.description}"),
            BarColumn(24),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TextColumn("{task.fields[text]}", markup=False),
        )
        with Progress(*columns, console=self._out) as progress:
            yield Bar(self._out, self._errors, progress, title)


def _show(console: RichConsole, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)
