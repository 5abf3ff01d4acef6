"""Options that several verbs share, and how optional ones look in their help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

__all__ = [
    "Free",
    "OptionalFolder",
    "OptionalInt",
    "OptionalName",
    "OptionalNumber",
    "Protocol",
    "Steps",
    "Up",
    "ViewsUp",
    "optional",
]


def optional(metavar: str, **options: Any) -> Any:
    """What tyro is told of an option that may be left out: no {None}, no (default: None)."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", **options)


OptionalFolder = Annotated[Path | None, optional("FOLDER")]
OptionalInt = Annotated[int | None, optional("INT")]
OptionalName = Annotated[str | None, optional("NAME")]
OptionalNumber = Annotated[int | float | None, optional("NUMBER")]

Protocol = Literal["default", "paper"]
"""A name in `hyperplanes.presets.PROTOCOLS`."""

Steps = int | Literal["auto"]
"""Fine-tuning steps, or as many as show left-out views best."""

Free = Literal["weights", "hypernetwork"]
"""What fine-tuning optimises."""

Up = Literal["y", "z"]
"""The axis that points up in the world of a data set."""

ViewsUp = Annotated[str, tyro.conf.arg(metavar="{auto,y,z,x,-y,-z,-x}")]
"""The axis that points up in the world of photographs, three numbers, or auto: as the cameras are held."""
