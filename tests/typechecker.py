"""The checker behind the import hook in conftest.py: beartype, with ints allowed where floats are, as PEP 484 says."""

import functools
import inspect

import jaxtyping
from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
SHAPES = ("Float[", "Int[", "Int32[", "Bool[", "UInt8[")


def install(package):
    """Check the functions of a package whose signature has shapes, and its classes that have any.

    The others are pyright's. Functions inside others are left alone, too: they would be compiled anew, in a millisecond
    each, whenever these are called.
    """
    jaxtyping.jaxtyped = functools.partial(_checked, jaxtyping.jaxtyped)
    jaxtyping.install_import_hook(package, "typechecker.check")


def _checked(original, *, typechecker):
    def decorate(value):
        if not (inspect.isfunction(value) or inspect.isclass(value)):  # a property, a class method
            return original(typechecker=typechecker)(value)
        annotations = map(str, getattr(value, "__annotations__", {}).values())
        shaped = any(name in each for each in annotations for name in SHAPES)
        return original(typechecker=typechecker)(value) if shaped and "<locals>" not in value.__qualname__ else value

    return decorate
