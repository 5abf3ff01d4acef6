"""List the named configurations that `train --preset` accepts, or print all settings of one as YAML.

Example:
    hyperplanes presets
    hyperplanes presets quick > mine.yaml    # to be changed and given to `hyperplanes train --config mine.yaml`
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from hyperplanes.commands.options import optional
from hyperplanes.commands.output.console import Console

if TYPE_CHECKING:
    from hyperplanes.configuration.presets import Preset

__all__ = ["HEADINGS", "Arguments", "row", "run"]

HEADINGS = ("preset", "pixels", "network", "encoder", "views read", "sampling", "steps", "rays a step")


@dataclass(frozen=True)
class Arguments:
    """The options of `presets`.

    Attributes:
        name: The preset whose settings are printed. By default all presets are listed.
    """

    name: tyro.conf.Positional[Annotated[str | None, optional("[NAME]")]] = None


def row(name: str, preset: Preset) -> tuple[str, ...]:
    """One preset as the cells of the table."""
    from hyperplanes.fields import find_targets
    from hyperplanes.hypernetwork import ImageHyperNetworkConfig

    model, training = preset.model, preset.training
    hyper, any_views = model.hypernetwork, find_targets()[model.target].permutation_invariant
    planes = "any" if any_views else model.network.planes
    images = hyper if isinstance(hyper, ImageHyperNetworkConfig) else None
    read = f"{images.views if images else 0} of {planes}"
    return (
        name,
        str(preset.resolution),
        f"{model.network.depth} x {model.network.width}",
        images.encoder if images else "volume" if hyper else "-",
        "all views" if hyper and not images else read,
        model.sampling.summary,
        f"{training.steps:,}",
        str(training.rays * training.tasks),
    )


def run(arguments: Arguments) -> int:
    """Print the table of presets, or all settings of one."""
    from hyperplanes.configuration.presets import PRESETS, preset
    from hyperplanes.configuration.settings_file import document

    console = Console()
    if arguments.name is not None:
        console.say(document(preset(arguments.name)).rstrip())
        return 0
    console.table(HEADINGS, [row(name, each) for name, each in PRESETS.items()])
    console.say("")
    for name, each in PRESETS.items():
        console.say(f"{name}: {each.about}")
    return 0
