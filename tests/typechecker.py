"""The type checker of the import hook in conftest.py: beartype, which accepts ints for floats, as in PEP 484.

Each kind of call is checked once, because a check takes a quarter of a millisecond and a training makes thousands of
calls of a few kinds. Two calls are of the same kind if their arguments and results have the same classes, dtypes and
small sizes, and their large sizes are equal to each other in the same places.
"""

import functools
import inspect
import threading
import types

import jaxtyping
import numpy as np
import torch
from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
SHAPES = ("Float[", "Int[", "Int32[", "Bool[", "UInt8[")
NAMED = 16
"""Sizes below this are compared by value, because annotations may name them (`"point 3"`); larger ones by order."""


def install(package):
    """Check the functions of a package whose signatures have shapes, and its dataclasses whose fields have shapes.

    All others are checked by pyright. Nested functions are not checked, because their checks would be compiled in a
    millisecond at each call of the outer function.
    """
    jaxtyping.jaxtyped = functools.partial(_checked, jaxtyping.jaxtyped)
    jaxtyping.install_import_hook(package, "typechecker.check")


def _checked(original, *, typechecker):
    wrap = functools.partial(original, typechecker=typechecker)

    def decorate(value):
        if not (inspect.isfunction(value) or inspect.isclass(value)):  # a property, a class method
            return wrap(value)
        annotations = map(str, getattr(value, "__annotations__", {}).values())
        shaped = any(name in each for each in annotations for name in SHAPES)
        if not shaped or "<locals>" in value.__qualname__:
            return value
        if inspect.isfunction(value):
            return checked_once(value, wrap)
        if hasattr(value, "__dataclass_fields__") and "__init__" in vars(value):
            value.__init__ = checked_once(value.__init__, wrap)
        return value

    return decorate


def checked_once(function, wrap):
    """A function that calls `wrap(function)` for the first call of each kind, and `function` afterwards."""
    seen, made, held, this_thread = {}, {}, {}, threading.get_ident  # made when needed, in a millisecond each

    def checked():
        if "function" not in made:
            made["function"] = wrap(function)
        return made["function"]

    def check_result(result, given, named):
        """Check a result without calling the function again."""

        def returned(*_, **__):
            return held[this_thread()]

        if "result" not in made:  # with the globals that the annotations refer to
            again = types.FunctionType(
                returned.__code__, function.__globals__, function.__name__, None, returned.__closure__
            )
            made["result"] = wrap(functools.update_wrapper(again, function))
        held[this_thread()] = result
        try:
            made["result"](*given, **named)
        finally:
            del held[this_thread()]

    @functools.wraps(function)
    def call(*given, **named):
        __tracebackhide__ = True
        if jaxtyping.config.jaxtyping_disable:
            return function(*given, **named)
        found, sizes = [], {}
        for each in given:
            describe(each, found, sizes)
        for name, each in named.items():
            found.append(name)
            describe(each, found, sizes)
        arguments, found = tuple(found), []
        results = seen.get(arguments)
        result = (checked() if results is None else function)(*given, **named)
        describe(result, found, sizes)
        kind = tuple(found)
        if results is None or kind not in results:
            if results is not None:
                check_result(result, given, named)
            seen.setdefault(arguments, set()).add(kind)
        return result

    return call


class _Forms(dict):
    """How `describe` treats the values of a class; cached, because a training step has a thousand arguments."""

    def __missing__(self, cls):
        forms = {"array": (torch.Tensor, np.ndarray), "sequence": (tuple, list), "mapping": dict, "text": str}
        self[cls] = next((name for name, classes in forms.items() if issubclass(cls, classes)), "other")
        return self[cls]


FORMS = _Forms()


def describe(value, found, sizes):
    """Append what the check of a value depends on to a list; `sizes` numbers large sizes in order of appearance."""
    cls = type(value)
    found.append(cls)
    form = FORMS[cls]
    if form == "other":
        return
    if form == "array":
        found.append(value.dtype)
        for size in value.shape:
            found.append(size if size < NAMED else sizes.setdefault(size, -1 - len(sizes)))
    elif form == "sequence":
        found.append(len(value))
        for each in value:
            describe(each, found, sizes)
    elif form == "mapping":
        found.append(len(value))
        for key, each in value.items():
            found.append(key)
            describe(each, found, sizes)
    else:
        found.append(value)
