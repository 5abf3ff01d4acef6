"""The options of a verb, parsed from a command line. Wrong ones are refused in one line, before torch is imported."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, dataclass, fields, replace
from types import ModuleType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from hyperplanes.commands import split_settings
from hyperplanes.commands.options import Exists
from hyperplanes.utilities.entry_points import find_entries
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["as_option", "parse"]

HELP = {"-h", "--help"}


def parse(verb: str, module: ModuleType, arguments: Sequence[str]) -> Any:
    """The options of a verb.

    Args:
        verb: its name.
        module: with its `Arguments`.
        arguments: the command line after the verb.

    Returns:
        An instance of `module.Arguments`.

    An unknown, repeated or missing option and a value that an option cannot have raise ValueError. Requested help is
    printed and raises SystemExit.
    """
    rest, settings = list(arguments), []
    wants_help = not HELP.isdisjoint(rest)
    if not wants_help:
        _refuse_repeated(rest)
    if "settings" in module.Arguments.__annotations__:  # options with a dot, such as --model.hypernetwork.views 3
        rest, settings = split_settings(rest)
    rest = _with_axes(rest)
    if not wants_help:
        _check_words(verb, module.Arguments, rest)
    parsed = tyro.cli(
        module.Arguments,
        prog=f"hyperplanes {verb}",
        description="\n\n".join([inspect.cleandoc(module.__doc__ or ""), *_names_of_other_packages(module)]),
        args=rest,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff),
    )
    _check_values(parsed)
    return replace(parsed, settings=tuple(settings)) if settings else parsed


def as_option(message: str, module: ModuleType, arguments: Sequence[str]) -> str:
    """A message about arguments of a function, as one about the options that set them.

    Args:
        message: such as "field_of_view: expected ..."; any other is returned unchanged.
        module: of the verb.
        arguments: the command line after the verb. If two options may be meant, it is the one that was given.
    """
    fields_of = {each.name: each.field for each in _options_of(module.Arguments)}
    given = {_name_of(argument) for argument in arguments}

    def option(argument: str) -> str | None:
        meant = [name for name, field in fields_of.items() if argument in (field, name[2:].replace("-", "_"))]
        return min(meant, key=lambda name: name not in given, default=None)

    about, colon, rest = message.partition(": ")
    options = [option(each) for each in about.split(", ")]
    if not colon or None in options:
        return message
    return f"{', '.join(filter(None, options))}: {rest}"


def _refuse_repeated(arguments: Sequence[str]) -> None:
    """Refuse repeated options, because the parsers would silently keep only the last value.

    >>> _refuse_repeated(["--what", "images", "mesh", "--page-voxels=64", "--page_voxels", "96"])
    Traceback (most recent call last):
    ValueError: --page-voxels: expected once, got it twice; an option that takes several values takes them side by side

    Raises:
        ValueError: a repeated option.
    """
    options = [_name_of(each) for each in arguments if each.startswith("--")]
    repeated = next((each for place, each in enumerate(options) if each in options[:place]), None)
    if repeated is not None:
        times = {2: "twice"}.get(options.count(repeated), f"{options.count(repeated)} times")
        several = "an option that takes several values takes them side by side"
        raise ValueError(f"{repeated}: expected once, got it {times}; {several}")


def _name_of(argument: str) -> str:
    """The name of an option as the help shows it."""
    return argument.partition("=")[0].replace("_", "-")


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


def _check_words(verb: str, declared: type, arguments: Sequence[str]) -> None:
    """Refuse what the parser would answer with its whole help text in a box.

    Raises:
        ValueError: an unknown or missing option, too few or too many values, or a value of another type.
    """
    options = {each.name: each for each in _options_of(declared)}
    positional = next((name for name in options if not name.startswith("--")), "")
    given: dict[str, list[str]] = {}
    at = positional
    for word in arguments:
        if word.startswith("--"):
            at = _name_of(word)
            given[at] = [word.partition("=")[2]] if "=" in word else []
        else:
            if positional and at in options and len(given.get(at, [])) >= options[at].most:
                at = positional
            given.setdefault(at, []).append(word)
    more = f"see hyperplanes {verb} --help"
    for name, values in given.items():
        if not name:
            raise ValueError(f"expected an option, got {values[0]}; {more}")
        if name not in options:
            raise ValueError(f"no option {name}{did_you_mean(name, [*options, '--help']) or f'; {more}'}")
        options[name].check(values)
    missing = [name for name, option in options.items() if option.required and name not in given]
    if missing:
        raise ValueError(f"missing {', '.join(missing)}; {more}")


@dataclass(frozen=True)
class _Option:
    """What an option takes, by the annotation of its field."""

    field: str
    name: str
    hint: Any
    required: bool

    @property
    def most(self) -> float:
        """The largest number of values."""
        return 0 if self.hint is bool else math.inf if get_origin(self.hint) is tuple else 1

    def check(self, values: Sequence[str]) -> None:
        """Refuse values that the option cannot have."""
        shown = " ".join(values)
        if len(values) > self.most:
            raise ValueError(f"{self.name}: expected {'one value' if self.most else 'no value'}, got {shown}")
        if not values and self.most == 1:
            raise ValueError(f"{self.name}: expected a value, got none")
        if "" in values:  # as of a shell variable that is not set; an empty path would be the current folder
            raise ValueError(f"{self.name}: expected a value, got an empty one")
        kinds = list(_kinds(get_args(self.hint)[0] if self.most > 1 else self.hint))
        for value in values:
            if not any(_reads(value, kind) for kind in kinds):
                names = [f"one of {', '.join(kind)}" if len(kind) > 1 else kind[0] for kind in kinds if _is_words(kind)]
                numbers = [NUMBERS[kind] for kind in (float, int) if kind in kinds]
                raise ValueError(f"{self.name}: expected {' or '.join([*numbers[:1], *names])}, got {value}")


NUMBERS = {float: "a number", int: "a whole number"}


def _options_of(declared: type) -> Iterator[_Option]:
    """The options that the fields of a dataclass declare; the name of a positional one has no dashes."""
    hints = get_type_hints(declared, include_extras=True)
    for each in fields(declared):
        hint, notes = _unannotated(hints[each.name])
        if each.name == "settings":
            continue
        renamed = next((note.name for note in notes if getattr(note, "name", None)), None)
        name = renamed or each.name.replace("_", "-")
        positional = any(repr(note) == "Positional" for note in notes)
        yield _Option(each.name, name.upper() if positional else f"--{name}", hint, _is_required(each))


def _is_required(each: Field[Any]) -> bool:
    return each.default is MISSING and each.default_factory is MISSING


def _unannotated(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type and the notes on it."""
    if get_origin(hint) is Annotated:
        inner, *notes = get_args(hint)
        found, more = _unannotated(inner)
        return found, (*notes, *more)
    return hint, ()


def _kinds(hint: Any) -> Iterator[Any]:
    """The types that one value may have; of a Literal, its words."""
    hint, _ = _unannotated(hint)
    if get_origin(hint) in (Union, UnionType):
        for part in get_args(hint):
            yield from _kinds(part)
    elif get_origin(hint) is Literal:
        yield get_args(hint)
    else:
        yield hint


def _is_words(kind: Any) -> bool:
    return isinstance(kind, tuple)


def _reads(value: str, kind: Any) -> bool:
    """Whether a value can be read as one of a type."""
    if _is_words(kind):
        return value in kind
    if kind is type(None):
        return value == "None"
    if kind not in NUMBERS:
        return True
    try:
        kind(value)
    except ValueError:
        return False
    return True


def _check_values(parsed: Any) -> None:
    """Refuse numbers outside the range and paths without the file that a verb declares.

    The parser checks neither, and the verb would import torch first.

    Raises:
        ValueError: such a value.
    """
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
