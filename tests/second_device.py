"""A PyTorch device in CPU memory, for tests on machines without a GPU: it raises the errors that a GPU raises.

Operations on its tensors are computed on the CPU. They raise if operands are on different devices, and NumPy cannot
read its tensors. It is a backend that is written in Python (`torch.utils.backend_registration`).
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

__all__ = ["AVAILABLE", "NAME", "register", "second_device"]

NAME = "second"
AVAILABLE = hasattr(backend_registration, "_setup_privateuseone_for_python_backend")
"""Whether this version of PyTorch supports backends that are written in Python."""

_ATEN = torch.ops.aten
_MOVING = {_ATEN._to_copy.default, _ATEN.copy_.default}
_INDEXING = {_ATEN.index.Tensor, _ATEN.index_put_.default, _ATEN.index_put.default, _ATEN._index_put_impl_.default}
"""Operators whose indices may be on the CPU."""
_WITHOUT_OPERATOR = {Tensor.new_tensor, Tensor.tolist, Tensor.numpy}


@contextmanager
def second_device() -> Generator[torch.device]:
    """The device, which can be used inside the context. `register` must be called before the first gradient."""
    with _Operations(), _Functions():
        yield torch.device(NAME, 0)


class _Remote(Tensor):
    """A tensor of the second device.

    Attributes:
        held: the same values in a CPU tensor.
    """

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> _Remote:
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        made = Tensor._make_wrapper_subclass(cls, held.size(), **layout, device=torch.device(NAME, 0))
        made.held = held
        return made

    def __repr__(self) -> str:
        return f"_Remote({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(operator, args, dict(kwargs or {}))


class _Operations(TorchDispatchMode):
    """Dispatches operators that create tensors on the device, and those with operands on it."""

    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if _is_second(kwargs.get("device")) or any(isinstance(each, _Remote) for each in _tensors(args, kwargs)):
            return _computed(operator, args, kwargs)
        return operator(*args, **kwargs)


class _Functions(TorchFunctionMode):
    """Handles functions that PyTorch implements without dispatching an operator."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if function in (torch.tensor, torch.as_tensor) and _is_second(kwargs.get("device")):
            return function(*args, **{**kwargs, "device": None}).to(kwargs["device"])
        if function not in _WITHOUT_OPERATOR or not isinstance(args[0], _Remote):
            return function(*args, **kwargs)
        if function is Tensor.new_tensor:
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(args[0].device)
        if function is Tensor.tolist:
            return args[0].detach().cpu().tolist()
        raise TypeError(f"can't convert a tensor on {NAME} to numpy; use .cpu() first")


def _computed(operator: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """The result of an operator with operands on the second device, or with a result there."""
    tensors = _tensors(args, kwargs)
    remote = any(isinstance(each, _Remote) for each in tensors)
    if remote and operator not in _MOVING:
        for value in [args[0], *args[2:3]] if operator in _INDEXING else tensors:
            if isinstance(value, Tensor) and value.ndim and not isinstance(value, _Remote):
                raise RuntimeError(
                    f"Expected all tensors to be on the same device, got {tuple(value.shape)} on {value.device} for "
                    f"{operator} on {NAME}"
                )
    asked = kwargs.get("device")
    if asked is not None:
        kwargs["device"] = torch.device("cpu")
    held_args = [_held(each) for each in args]
    held_kwargs = {name: _held(each) for name, each in kwargs.items()}
    if operator is _ATEN.copy_.default:
        held_args[0].copy_(held_args[1])
        return args[0]
    found = operator(*held_args, **held_kwargs)
    if not (_is_second(asked) if asked is not None else remote):
        return found
    found = _moved(found)
    return return_and_correct_aliasing(operator, args, kwargs, found) if remote and _aliases(operator) else found


@cache
def _aliases(operator: Any) -> bool:
    """Whether the result of an operator is one of its arguments, or a view of one."""
    return any(each.alias_info is not None for each in operator._schema.returns)


def _moved(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)(_moved(each) for each in value)
    return _Remote(value) if isinstance(value, Tensor) else value


def _held(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_held(each) for each in value]
    return value.held if isinstance(value, _Remote) else value


def _tensors(args: Sequence[Any], kwargs: Mapping[str, Any]) -> list[Tensor]:
    """The tensors among the arguments of an operator, and in lists among them."""
    values = [*args, *kwargs.values()]
    lists = [each for each in values if isinstance(each, list | tuple)]
    return [each for value in (values, *lists) for each in value if isinstance(each, Tensor)]


def _is_second(device: Any) -> bool:
    return device is not None and torch.device(device).type == NAME


@cache
def register() -> torch.library.Library | None:
    """Register the device with PyTorch, with functions that allocate memory and copy into it.

    It is not registered if there is a GPU, because autograd supports streams of only one kind of device.
    """
    if not AVAILABLE or torch.cuda.is_available():
        return None
    backend_registration._setup_privateuseone_for_python_backend(NAME)

    def empty(size: Any, *, dtype: Any = None, **_: Any) -> Tensor:
        return _Remote(torch.empty(size, dtype=dtype))

    def empty_strided(size: Any, stride: Any, *, dtype: Any = None, **_: Any) -> Tensor:
        return _Remote(torch.empty_strided(size, stride, dtype=dtype))

    def copy_from(source: Tensor, target: Tensor, non_blocking: bool = False) -> Tensor:
        _held(target).copy_(_held(source))
        return target

    library = torch.library.Library("aten", "IMPL")
    functions = {"empty.memory_format": empty, "empty_strided": empty_strided, "_copy_from": copy_from}
    for name, function in functions.items():
        library.impl(name, function, "PrivateUse1")
    return library
