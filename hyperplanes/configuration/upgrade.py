"""Settings as earlier versions wrote them, by the names of this one: of checkpoints and of files of settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["upgrade_model"]

RENAMED = {"hull_side": "hull_resolution"}
"""Entries of a model by their former names."""


def upgrade_model(entries: Any) -> Any:
    """The entries of a model, or some of them, as this version names them.

    >>> upgrade_model({"hull_side": 64})
    {'hull_resolution': 64}

    Args:
        entries: what a file or options say; anything but a mapping is returned as it is.
    """
    if not isinstance(entries, Mapping):
        return entries
    return {RENAMED.get(name, name): value for name, value in entries.items()}
