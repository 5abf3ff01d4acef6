"""The command `hyperplanes VERB`: it parses the command line, runs the verb and prints errors.

The module of a verb is imported only when the verb is used, so `hyperplanes --help` loads neither torch nor OpenGL.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from hyperplanes.commands import EXAMPLES, find_verb, find_verbs
from hyperplanes.utilities.machine.interrupts import Terminated, interruptible
from hyperplanes.utilities.messages.errors import (
    TRACEBACK_VARIABLE,
    MissingPackageError,
    is_memory,
    nearest,
    one_line,
    wants_traceback,
)

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        arguments: the command line after `hyperplanes`; by default that of this process.

    Returns:
        The exit code: 0 for success, 1 if the verb finished but found a problem, 2 for wrong input, 130 if interrupted,
        143 if terminated, 129 if the terminal was closed. The help of a verb raises SystemExit.
    """
    ended = None
    try:
        with _one_line_warnings():
            code = _main(arguments)
    except SystemExit as end:
        code, ended = 0, end
    written = _flush()
    if written is not None and code == 0:
        return _print_error(f"hyperplanes: standard output: {one_line(written)}")
    if ended is not None:
        raise ended
    return code


def _flush() -> OSError | None:
    """Flush standard output; returns the error if that fails."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        sys.stdout = None  # the process that reads the output has ended: Python must not flush to it again
    except OSError as error:
        sys.stdout = None
        return error
    return None


def _main(arguments: Sequence[str] | None) -> int:
    given = list(sys.argv[1:] if arguments is None else arguments)
    traceback = "--traceback" in given or wants_traceback()
    given = [argument for argument in given if argument != "--traceback"]
    if not given or given[0] in ("-h", "--help", "help"):
        return _print(_overview()) or (0 if given else 2)
    if given[0] == "--version":
        from importlib.metadata import version

        return _print(f"hyperplanes {version('hyperplanes')}")
    verb, *rest = given
    if verb.startswith("-"):
        return _print_error(f"hyperplanes: no option {verb}; {nearest(verb, ['--help', '--version'])}")
    try:
        found = find_verb(verb)
    except ValueError as error:
        return _print_error(f"hyperplanes: {error}")
    module = None
    try:
        with interruptible():
            from hyperplanes.commands.parsing import parse

            module = found.load()
            return module.run(parse(verb, module, rest))
    except KeyboardInterrupt as interrupt:
        resumes = getattr(module, "RESUMES", False)
        usual = "the same command resumes where possible" if resumes else "run the same command again to start over"
        advice = str(interrupt) or usual
        code = interrupt.code if isinstance(interrupt, Terminated) else 130
        with suppress(OSError):  # the terminal may be closed
            _print_error(f"hyperplanes {verb}: {'interrupted' if code == 130 else 'terminated'}; {advice}")
        return code
    except BrokenPipeError:
        sys.stdout = None  # as in `_flush`
        return 0
    except (ValueError, OSError, MemoryError, RuntimeError) as error:
        if traceback or not (isinstance(error, ValueError | OSError | MissingPackageError) or is_memory(error)):
            raise
        message = one_line(error)
        if module is not None:
            from hyperplanes.commands.parsing import as_option

            message = as_option(message, module, rest)
        return _print_error(f"hyperplanes {verb}: {message}")


@contextmanager
def _one_line_warnings() -> Generator[None]:
    """Print a UserWarning as one line, without the place in the code that raised it, and each text once."""
    usual, printed = warnings.formatwarning, set[str]()

    def formatted(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> str:
        if category is not UserWarning:
            return usual(message, category, *place, **more)
        line = f"warning: {' '.join(str(message).split())}\n"
        if line in printed:  # Python forgets what it has shown whenever code changes the filters
            return ""
        printed.add(line)
        return line

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _print(text: str) -> int:
    """Print a text to standard output; returns the exit code."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        sys.stdout = None  # as in `_flush`
    except OSError as error:
        sys.stdout = None
        return _print_error(f"hyperplanes: standard output: {one_line(error)}")
    return 0


def _print_error(line: str) -> int:
    print(line, file=sys.stderr)
    return 2


def _overview() -> str:
    found = find_verbs()
    width = max(map(len, found))
    verbs = "\n".join(f"  {name:<{width}}  {verb.about}" for name, verb in found.items())
    return (
        "usage: hyperplanes VERB [OPTIONS]\n\n"
        "A hypernetwork reads a few posed images of an object and predicts a NeRF of it in one forward pass.\n\n"
        f"verbs (`hyperplanes VERB --help` lists the options):\n{verbs}\n\n"
        f"examples:\n{EXAMPLES}\n\n"
        "options:\n"
        "  --help       show this text\n"
        "  --version    show the version\n"
        f"  --traceback  with any verb: show the traceback of an error (or set {TRACEBACK_VARIABLE}=1)"
    )


if __name__ == "__main__":
    sys.exit(main())
