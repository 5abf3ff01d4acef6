"""Readers of data sets and posed images in many layouts, which return views and few-shot tasks."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hyperplanes.utilities.files.reading import DataError

if TYPE_CHECKING:
    from hyperplanes.data.channels import mesh_path, read_channel
    from hyperplanes.data.dataset import Dataset, open_dataset, read_task, read_views

__all__ = ["DataError", "Dataset", "mesh_path", "open_dataset", "read_channel", "read_task", "read_views"]

_MODULES = {"Dataset": "dataset", "open_dataset": "dataset"}
_MODULES |= {"mesh_path": "channels", "read_channel": "channels"}
_MODULES |= {"read_task": "dataset", "read_views": "dataset"}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that writing files does not import torch."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
