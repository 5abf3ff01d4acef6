"""Options that several verbs share, and how optional ones look in their help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

__all__ = [
    "Free",
    "OptionalField",
    "OptionalFolder",
    "OptionalInt",
    "OptionalName",
    "OptionalNumber",
    "Protocol",
    "Steps",
    "Trainable",
    "Up",
    "optional",
]


def optional(metavar: str, **options: Any) -> Any:
    """What tyro is told of an option that may be left out: no {None}, no (default: None)."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", **options)


OptionalFolder = Annotated[Path | None, optional("FOLDER")]
OptionalField = Annotated[Literal["nerf", "multiplane", "point_multiplane"] | None, optional("FIELD")]
OptionalInt = Annotated[int | None, optional("INT")]
OptionalName = Annotated[str | None, optional("NAME")]
OptionalNumber = Annotated[int | float | None, optional("NUMBER")]

Protocol = Literal["default", "paper"]
"""A name in `hyperplanes.presets.PROTOCOLS`."""

Steps = int | Literal["auto"]
"""Fine-tuning steps, or as many as show left-out views best."""

Trainable = Literal[
    "hyperplanes", "point_multiplane", "multiplane", "nerf", "autoencoder", "mv_meta", "sv_meta", "maml",
    "maml_first_order", "mv_matched",
]  # fmt: skip
"""A name in `hyperplanes.presets.TRAINABLE`."""

Free = Literal["weights", "hypernetwork"]
"""What fine-tuning optimises."""

Up = Literal["y", "z"]
"""The axis that points up in the world of posed images."""
