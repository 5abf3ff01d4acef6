"""Makes the runner of experiments for `demo` and `reproduce`: it generates data and shows the progress of trainings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hyperplanes.commands.output.console import Console
    from hyperplanes.configuration.presets import Preset
    from hyperplanes.experiments.engine import Runner
    from hyperplanes.experiments.paper.experiment import Trained
    from hyperplanes.experiments.paper.scales import Scale
    from hyperplanes.experiments.workers import Workers
    from hyperplanes.experiments.workspace import Workspace
    from hyperplanes.views import Tasks

__all__ = ["count_workers", "make_runner", "make_workers"]

MAX_DEFAULT_WORKERS = 4
"""Most workers by default, because each holds the data set that it trains on in memory."""


def count_workers(asked: int | None, device: str) -> int:
    """The requested number of workers; by default one per core, at most MAX_DEFAULT_WORKERS, and a single one on a GPU.

    Raises:
        ValueError: less than one worker.
    """
    from hyperplanes.data.devices import choose_device
    from hyperplanes.utilities.machine.environment import usable_cores

    if asked is not None:
        if asked < 1:
            raise ValueError(f"--workers: expected at least 1, got {asked}")
        return asked
    return min(MAX_DEFAULT_WORKERS, usable_cores()) if choose_device(device).type == "cpu" else 1


def make_workers(count: int, out: Path, scale: Scale, device: str, **given: Any) -> Workers | None:
    """A context with processes for the runner of a folder; None if `count` is 1, since this process then does the work.

    Args:
        count: number of processes.
        out: the folder of the workspace.
        scale: the scale of the experiment.
        device: auto, or the name of a device.
        given: as in `make_runner`.
    """
    from hyperplanes.experiments.workers import Workers

    return Workers(count, partial(_worker_runner, out, scale, device, **given)) if count > 1 else None


def _worker_runner(out: Path, scale: Scale, device: str, **given: Any) -> Runner:
    """The runner of a worker process. It gets the folders of generated data sets with each piece of work."""
    from hyperplanes.commands.output.console import Console
    from hyperplanes.experiments.workspace import Workspace

    console = Console(plain=True)
    return make_runner(Workspace(out), scale, console=console, device=device, announce=lambda line: None, **given)


def make_runner(
    workspace: Workspace,
    scale: Scale,
    *,
    console: Console,
    device: str,
    announce: Callable[[str], None],
    workers: Workers | None = None,
    **given: Any,
) -> Runner:
    """A runner that generates data sets, trains models, and shows the progress.

    Args:
        workspace: the folder for all results.
        scale: the scale of the experiment.
        console: shows the progress.
        device: auto, or the name of a device.
        announce: called with a line before each training.
        workers: as in `Runner`.
        given: further arguments of `DataSets`: the given data sets, and how they are read.
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
        named.pop("contents", None)  # only identifies the data set: it changes if the meshes in the folder change
        objects = {} if "meshes" in named else {"class_name": class_name, "count": count}
        verb.run(verb.Arguments(folder, **objects, **named))

    def train(trained: Trained, chosen: Preset, data: Tasks, reference: Path | None, folder: Path) -> None:
        config = chosen.training
        announce(f"training {trained.method} on {trained.on}, seed {config.seed}, {config.steps:,} steps: {folder}")
        trainer = start_training(chosen.model, config, data, folder, where, reference)
        if trainer.step:
            console.say(f"resuming from step {trainer.step}")
        with console.bar(trained.method) as bar:
            follow(trainer, bar)

    data = DataSets(workspace, scale, generate=generate, device=where, **given)
    return Runner(workspace, data, train=train, device=where, workers=workers)
