"""The engine of experiments with what a person sees of it: data by `generate`, trainings with a progress line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hyperplanes.commands.console import Console
    from hyperplanes.configuration.presets import Preset
    from hyperplanes.experiments.engine import Runner
    from hyperplanes.experiments.experiment import Trained
    from hyperplanes.experiments.scales import Scale
    from hyperplanes.experiments.workspace import Workspace
    from hyperplanes.views import Tasks

__all__ = ["make_runner"]


def make_runner(
    workspace: Workspace, scale: Scale, *, console: Console, device: str, announce: Callable[[str], None], **given: Any
) -> Runner:
    """A runner that generates, trains and says how it goes.

    Args:
        workspace: the folder for everything.
        scale: how large.
        console: where it is said.
        device: auto, or the name of one.
        announce: called with a line before a training.
        given: of `DataSets`: which are given, and how they are read.
    """
    from hyperplanes.commands import find_verb
    from hyperplanes.commands.train import follow
    from hyperplanes.data.devices import choose_device
    from hyperplanes.experiments.data_sets import DataSets
    from hyperplanes.experiments.engine import Runner
    from hyperplanes.training import start_training

    where = choose_device(device)

    def generate(settings: Mapping[str, Any], folder: Path) -> None:
        verb, named = find_verb("generate").load(), dict(settings)
        class_name, count = named.pop("class"), named.pop("objects")
        objects = {} if "meshes" in named else {"class_name": class_name, "count": count}
        verb.run(verb.Arguments(folder, **objects, **named))

    def train(trained: Trained, chosen: Preset, data: Tasks, reference: Path | None, folder: Path) -> None:
        config = chosen.training
        announce(f"training {trained.method} on {trained.on}, seed {config.seed}, {config.steps:,} steps: {folder}")
        trainer = start_training(chosen.model, config, data, folder, where, reference)
        if trainer.step:
            console.say(f"going on from step {trainer.step}")
        with console.bar(trained.method) as bar:
            follow(trainer, bar)

    data = DataSets(workspace, scale, generate=generate, device=where, **given)
    return Runner(workspace, data, train=train, device=where)
