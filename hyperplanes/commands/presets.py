"""List the named configurations that `train --preset` knows.

Example:
    hyperplanes presets
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hyperplanes.commands.console import Console

if TYPE_CHECKING:
    from hyperplanes.presets import Preset

__all__ = ["HEADINGS", "Arguments", "row", "run"]

HEADINGS = ("preset", "pixels", "network", "encoder", "shown", "sampling", "steps", "rays a step")


@dataclass(frozen=True)
class Arguments:
    """Nothing to choose."""


def row(name: str, preset: Preset) -> tuple[str, ...]:
    """One preset as the cells of the table."""
    model, training = preset.model, preset.training
    hyper = model.hypernetwork
    return (
        name,
        str(preset.resolution),
        f"{model.network.depth} x {model.network.width}",
        hyper.encoder if hyper else "-",
        f"{hyper.views if hyper else 0} of {model.network.planes}",
        model.sampling.summary,
        f"{training.steps:,}",
        str(training.rays * training.tasks),
    )


def run(arguments: Arguments) -> int:
    """Print the table."""
    from hyperplanes.presets import PRESETS

    console = Console()
    console.table(HEADINGS, [row(name, preset) for name, preset in PRESETS.items()])
    console.say("")
    for name, preset in PRESETS.items():
        console.say(f"{name}: {preset.about}")
    return 0
