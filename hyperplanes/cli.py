"""The command `hyperplanes VERB`: it parses the command line, runs the verb and prints errors.

The module of a verb is imported only when the verb is used, so `hyperplanes --help` loads neither torch nor OpenGL.
"""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import ModuleType
from typing import Any, get_type_hints

from hyperplanes.commands import EXAMPLES, find_verb, find_verbs, split_settings
from hyperplanes.utilities.entry_points import find_entries
from hyperplanes.utilities.machine.interrupts import Terminated, interruptible
from hyperplanes.utilities.messages.errors import (
    TRACEBACK_VARIABLE,
    MissingPackageError,
    is_memory,
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
        143 if terminated, 129 if the terminal was closed. An unknown option and the help of a verb raise SystemExit.
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
    try:
        found = find_verb(verb)
    except ValueError as error:
        return _print_error(f"hyperplanes: {error}")
    try:
        with interruptible():
            return _run(verb, found.load(), rest)
    except KeyboardInterrupt as interrupt:
        advice = str(interrupt) or "the same command resumes where possible"
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
        return _print_error(f"hyperplanes {verb}: {one_line(error)}")


@contextmanager
def _one_line_warnings() -> Generator[None]:
    """Print a UserWarning as one line, without the place in the code that raised it."""
    usual = warnings.formatwarning

    def formatted(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> str:
        if category is not UserWarning:
            return usual(message, category, *place, **more)
        return f"warning: {' '.join(str(message).split())}\n"

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _run(verb: str, module: ModuleType, rest: list[str]) -> int:
    import tyro

    _refuse_repeated(rest)
    settings: list[str] = []
    if "settings" in module.Arguments.__annotations__:  # options with a dot, such as --model.hypernetwork.views 3
        rest, settings = split_settings(rest)
    rest = _with_axes(rest)
    parsed = tyro.cli(
        module.Arguments,
        prog=f"hyperplanes {verb}",
        description="\n\n".join([inspect.cleandoc(module.__doc__ or ""), *_names_of_other_packages(module)]),
        args=rest,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff),
    )
    _check_values(parsed)
    return module.run(replace(parsed, settings=tuple(settings)) if settings else parsed)


def _refuse_repeated(arguments: Sequence[str]) -> None:
    """Refuse repeated options, because the parsers would silently keep only the last value.

    >>> _refuse_repeated(["--what", "images", "mesh", "--page-voxels=64", "--page_voxels", "96"])
    Traceback (most recent call last):
    ValueError: --page-voxels: expected once, got it twice; an option that takes several values takes them side by side

    Raises:
        ValueError: a repeated option, unless help is requested.
    """
    options = [each.partition("=")[0].replace("_", "-") for each in arguments if each.startswith("--")]
    repeated = next((each for place, each in enumerate(options) if each in options[:place]), None)
    if repeated is not None and not {"-h", "--help"} & set(arguments):
        times = {2: "twice"}.get(options.count(repeated), f"{options.count(repeated)} times")
        several = "an option that takes several values takes them side by side"
        raise ValueError(f"{repeated}: expected once, got it {times}; {several}")


def _with_axes(arguments: list[str]) -> list[str]:
    """The arguments with `--up -y` written as `--up=-y`, because the parser would read `-y` as an option.

    >>> _with_axes(["--up", "-y", "--size", "64"])
    ['--up=-y', '--size', '64']
    """
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == "--up" and argument in ("-x", "-y", "-z"):
            joined[-1] = f"--up={argument}"
        else:
            joined.append(argument)
    return joined


def _check_values(parsed: Any) -> None:
    """Refuse numbers outside the range and paths without the file that a verb declares.

    The parser checks neither, and the verb would import torch first.

    Raises:
        ValueError: such a value.
    """
    from hyperplanes.commands.options import Exists

    for name, hint in get_type_hints(type(parsed), include_extras=True).items():
        value = getattr(parsed, name)
        for note in getattr(hint, "__metadata__", ()):
            if isinstance(note, range) and value is not None and value not in note:
                expected = f"a whole number from {note[0]} to {note[-1]}"
                raise ValueError(f"--{name.replace('_', '-')}: expected {expected}, got {value}")
            if isinstance(note, Exists) and value is not None:
                for path in value if isinstance(value, tuple) else [value]:
                    note.check(path)


def _names_of_other_packages(module: ModuleType) -> list[str]:
    """Lines for the help of a verb: the names that other installed packages add. The packages are not imported."""
    groups: dict[str, str] = getattr(module, "BROUGHT", {})
    found = {what: sorted(each.name for each in find_entries(group)) for what, group in groups.items()}
    return [f"{what} of other packages: {', '.join(names)}." for what, names in found.items() if names]


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
