"""Train a model on a data set; what `generate` writes, or any other layout that `inspect` can read.

The model is evaluated on held-out objects at intervals. Checkpoints are written to --out on the way; interrupted, the
same command goes on from the last one. Ctrl-C stops after a checkpoint; a second Ctrl-C stops immediately.
SIGTERM, as a cluster sends it, stops after a checkpoint too. Beside the weights lie config.yaml, which --config takes,
curve.csv, and samples/ with held-out views beside the truth; best/ holds the model that was best on held-out objects.

With --devices N, N processes of this machine share the objects of every step, one a GPU; --nodes M takes as many on
each of M machines. Started by torchrun, it takes the processes that torchrun has started.

Every field of the model and of the training is an option too, such as --model.hypernetwork.views 3 or
--training.learning-rate 1e-3; `hyperplanes presets quick` prints all of them with their values, as a file for --config.

Example:
    hyperplanes train --data data/cars --preset quick --out runs/cars
    hyperplanes train --data data/cars --preset quick --method point_multiplane --out runs/cars-baseline
    hyperplanes train --data data/cars --preset quick --method mv_meta --field nerf --out runs/cars-meta
    hyperplanes train --data data/cars --config runs/cars/config.yaml --model.hypernetwork.views 3 --out runs/cars-3
    hyperplanes train --data data/cars data/chairs --preset small --devices 4 --out runs/both
    hyperplanes train --data data/ships --preset small --checkpoint small --steps 2000 --out runs/ships
"""

from __future__ import annotations

import signal
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from hyperplanes.commands.console import Bar, Console
from hyperplanes.commands.options import (
    OptionalFolder,
    OptionalInt,
    OptionalName,
    OptionalNumber,
    Protocol,
    optional,
)
from hyperplanes.commands.writing import writes_to
from hyperplanes.utilities.formatting import format_duration, format_rate
from hyperplanes.utilities.interrupts import SIGNALS, HungUp, listened_to
from hyperplanes.utilities.processes import is_first_process
from hyperplanes.utilities.shell import command_line

if TYPE_CHECKING:
    from hyperplanes.configuration.presets import Preset
    from hyperplanes.training import Progress, Trainer
    from hyperplanes.training.monitoring import TensorBoard

__all__ = ["Arguments", "follow", "progress_line", "resolve", "run"]


BROUGHT = {"Fields": "hyperplanes.fields"}
"""Groups of entry points whose names are fields and methods."""


@dataclass(frozen=True)
class Arguments:
    """What to train, and on what.

    Attributes:
        data: The data set, or several whose objects are drawn alike.
        out: The folder for checkpoints; a training that was interrupted there goes on.
        config: A YAML file of settings, such as the config.yaml of another run, whole or in part.
        preset: One of `hyperplanes presets`: what holds where nothing else is said; quick where no file says otherwise.
        method: hyperplanes; a target network alone with one set of weights for all objects: point_multiplane,
            multiplane, nerf, image_based, or a field of another package; autoencoder; or a learned initialisation:
            mv_meta, sv_meta (Reptile from many views or a single one), maml, maml_first_order, mv_matched (random
            weights matched to mv_meta).
        field: Which target network: nerf, multiplane, point_multiplane, image_based, simplified_nerf, or that of
            another package; when not given the preset's, or for learned initialisations NeRF.
        support: Support views and ImagePlanes an object; more than the data set has are taken from its query views.
        checkpoint: Weights to begin with instead of random ones: a checkpoint, or a packaged model such as small; for
            mv_matched the checkpoint of mv_meta that it is to match.
        protocol: How rays are sampled: paper is 64 + 128 times each on every ray, ray_marching only where something is;
            as the preset says where not given.
        steps: Training steps; the preset's when not given.
        epochs: Instead of steps: how often each object is drawn, on average.
        seed: Of the first weights and of every draw.
        cache_size: GiB of memory for prepared objects, and as much again for their decoded pictures; 2 by default.
        legacy: The principal point of learnit's and the paper's own files is at W / 2 at integer pixel centres.
        tensorboard: Write event files for TensorBoard to --out/tensorboard.
        device: auto, cpu or cuda.
        devices: Processes on this machine that share the objects of every step: one a GPU, or several on the CPU.
        nodes: Machines that take part, each started with the same command, with MASTER_ADDR, MASTER_PORT and NODE_RANK
            in its environment; --out is a folder that all of them see.
    """

    data: tuple[Path, ...]
    out: Path
    config: Annotated[Path | None, optional("FILE")] = None
    preset: OptionalName = None
    method: OptionalName = None
    field: OptionalName = None
    support: OptionalInt = None
    checkpoint: OptionalFolder = None
    protocol: Protocol = "default"
    steps: OptionalInt = None
    epochs: OptionalInt = None
    seed: OptionalInt = None
    cache_size: OptionalNumber = None
    legacy: bool = False
    tensorboard: bool = False
    device: str = "auto"
    devices: int = 1
    nodes: int = 1
    settings: tyro.conf.Suppress[tuple[str, ...]] = ()


def progress_line(progress: Progress, best: float | None = None) -> str:
    """Loss, quality on held-out objects, speed, time left.

    Args:
        progress: of this step.
        best: the quality to show where this step did not look at it.
    """
    quality = progress.psnr if progress.psnr is not None else best
    held_out = f"held-out {quality:5.2f} dB" if quality is not None else "held-out    -    "
    return (
        f"loss {progress.loss:.4f}  {held_out}  {format_rate(progress.rays_per_second):>6} rays/s  "
        f"{format_duration(progress.seconds_left)} left"
    )


@contextmanager
def _polite_interrupt(trainer: Trainer, bar: Bar) -> Generator[list[type[KeyboardInterrupt]]]:
    """The first Ctrl-C, SIGTERM or SIGHUP ends the training after its step, the second one at once.

    A terminal that is closed sends SIGHUP more than once, which counts as one.

    Yields:
        What was heard.
    """
    heard: list[type[KeyboardInterrupt]] = []

    def note(number: int, _: object) -> None:
        if number == signal.SIGHUP and HungUp in heard:
            return
        heard.append(SIGNALS[number])
        if len(heard) > 1:
            raise heard[-1]
        trainer.stopping = True
        bar.warn(f"{signal.Signals(number).name}: stopping after this step; once more to stop at once")

    before = {number: signal.signal(number, note) for number in listened_to()}
    try:
        yield heard
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def follow(trainer: Trainer, bar: Bar, board: TensorBoard | None = None) -> None:
    """Train to the end and show how it goes.

    Args:
        trainer: at any step.
        bar: where a line a report is shown.
        board: where every report goes as well.

    After Ctrl-C it ends in a KeyboardInterrupt with a checkpoint written and advice as its text, after SIGTERM in
    `Terminated` and after SIGHUP in `HungUp`, likewise.
    """
    from hyperplanes.adaptation.diagnostics import SMALLEST_SPREAD

    quality = None
    with _polite_interrupt(trainer, bar) as heard:
        warned = False
        for progress in trainer.run():
            quality = progress.psnr if progress.psnr is not None else quality
            if board is not None:
                board.add(trainer.curve[-1], trainer.samples if progress.psnr is not None else None)
            line = progress_line(progress, quality)
            if progress.diagnostics is not None:
                line += f"\n  {progress.diagnostics}"
                if progress.diagnostics.constant and not warned:
                    warned = True
                    bar.warn(
                        f"warning: at step {progress.step} the updates of different objects differ by less than "
                        f"{SMALLEST_SPREAD:.0%} of their norm: the hypernetwork writes the same update for every "
                        "object; see docs/hypernetwork.md for options that prevent it"
                    )
            bar.show(progress.step, progress.steps, line, important=progress.psnr is not None)
    if trainer.stopping and trainer.processes.first:
        advice = f"step {trainer.step} is saved, the same command goes on from there"
        raise heard[0](advice) if heard else KeyboardInterrupt(advice)


def resolve(arguments: Arguments) -> Preset:
    """The model and its training: the preset's, changed by the file, by the options, by the settings.

    Raises:
        ValueError: an unknown name, or a value that does not fit; the message names the file or the option.
    """
    from hyperplanes.configuration.presets import preset
    from hyperplanes.configuration.settings_file import changed, parse_options, read_experiment
    from hyperplanes.utilities.errors import prefix_errors
    from hyperplanes.utilities.settings import SettingsError

    given = read_experiment(arguments.config) if arguments.config else {}
    chosen = preset(arguments.preset or given.get("preset", "quick"))
    if "method" in given:
        chosen = chosen.by_method(given["method"])
    try:
        chosen = changed(chosen, given)
    except SettingsError as error:
        raise ValueError(f"{arguments.config}: {error}") from None
    chosen = chosen.by_protocol(arguments.protocol)
    if arguments.method or arguments.field:
        chosen = chosen.by_method(arguments.method or chosen.model.method, arguments.field)
    if arguments.epochs is not None and arguments.epochs < 1:
        raise ValueError(f"--epochs: expected at least 1, got {arguments.epochs}")
    options = {"steps": arguments.steps, "epochs": arguments.epochs, "seed": arguments.seed}
    if arguments.steps is not None:
        if arguments.epochs:
            raise ValueError(
                f"--steps, --epochs: expected one of the two, got {arguments.steps} and {arguments.epochs}"
            )
        options["epochs"] = 0
    if arguments.cache_size is not None:
        if not 0 <= arguments.cache_size < 2**20:
            raise ValueError(f"--cache-size: expected GiB from 0 to below {2**20}, got {arguments.cache_size:g}")
        options["memory"] = int(arguments.cache_size * 2**30)
    for name, value in options.items():
        if value is not None:
            try:
                chosen = changed(chosen, {"training": {name: value}})
            except SettingsError as error:
                raise ValueError(f"--{'cache-size' if name == 'memory' else name}: {error.problem}") from None
    try:
        stated = parse_options(arguments.settings)
        training = stated.get("training", {})
        if "steps" in training and "epochs" not in training:
            if arguments.epochs:
                raise ValueError("--training.steps, --epochs: expected one of the two, got both; leave one out")
            training["epochs"] = 0
        chosen = changed(chosen, stated)
    except SettingsError as error:
        raise ValueError(f"--{error.path.replace('_', '-')}: {error.problem}") from None
    if arguments.support is not None:
        with prefix_errors("--support"):
            network = replace(chosen.model.network, planes=arguments.support)
        chosen = replace(chosen, model=replace(chosen.model, network=network))
    return chosen


def _is_first(arguments: Arguments) -> bool:
    return is_first_process(arguments.devices * arguments.nodes)


@writes_to(lambda arguments: arguments.out, _is_first)
def run(arguments: Arguments) -> int:
    """Train, from the start or from where it was interrupted."""
    from hyperplanes.training.distributed import ProcessEnded

    try:
        return _run(arguments)
    except ProcessEnded:
        if _is_first(arguments):
            raise
        return 0  # who ended first says why


def _run(arguments: Arguments) -> int:
    from hyperplanes.adaptation.checkpoints import find_checkpoints
    from hyperplanes.configuration.settings_file import write_experiment
    from hyperplanes.data.dataset import open_datasets
    from hyperplanes.data.devices import choose_device
    from hyperplanes.data.support import WithSupport
    from hyperplanes.training import start_training
    from hyperplanes.training.distributed import check_shares
    from hyperplanes.training.episodes.loader import reference_objects
    from hyperplanes.training.launching import count_processes, launched
    from hyperplanes.training.monitoring import TensorBoard

    if arguments.out.resolve() in {path.resolve() for path in arguments.data}:
        raise ValueError(f"--out: expected a folder of its own, got {arguments.out}, which is --data; name another one")
    first = _is_first(arguments)
    console = Console(silent=not first)
    chosen = resolve(arguments)
    method = chosen.model.method
    data = open_datasets(arguments.data, chosen.training.memory, legacy=arguments.legacy)
    shown = " ".join(map(str, arguments.data))
    for line in data.skipped:
        console.warn(line)
    if not data.names("train"):
        raise ValueError(
            f"{shown}: expected objects to train on, found none in its train split; "
            "a single scene can only be rendered or evaluated"
        )
    if arguments.support is not None and chosen.training.views:
        raise ValueError(
            "--support: expected none, since training.views says how many views are shown; --training.views changes it"
        )
    tasks = data if arguments.support is None else WithSupport(data, arguments.support)
    reference = None
    if arguments.checkpoint is not None:
        reference = arguments.checkpoint
        if method == "mv_matched":
            reference = find_checkpoints([reference]).get("mv_meta", reference)
    processes = count_processes(arguments.devices, arguments.nodes)
    objects = reference_objects(chosen.model, chosen.training)
    check_shares(chosen.training.tasks, objects, processes[0] * processes[1])
    held_out = len(data.names("test"))
    with launched(*processes, choose_device(arguments.device)) as device:
        trainer = start_training(chosen.model, chosen.training, tasks, arguments.out, device, reference)
        if first:
            write_experiment(arguments.out / "config.yaml", chosen)
        shared = f", shared by {trainer.processes.count} processes" if trainer.processes.count > 1 else ""
        console.say(
            f"{method}: {sum(p.numel() for p in trainer.model.parameters()):,} weights, "
            f"{len(trainer.loader.names)} objects to train on, {held_out} held out{shared}"
        )
        if trainer.step:
            console.say(f"going on from step {trainer.step}")
        watched = arguments.tensorboard and first
        board = TensorBoard(arguments.out / "tensorboard", trainer.step) if watched else None
        try:
            with console.bar("training") as bar:
                follow(trainer, bar, board)
        finally:
            if board is not None:
                board.close()
    more = trainer.step > chosen.training.steps
    before = f" before, and for no more now: --steps is {chosen.training.steps}" if more else ""
    console.say(f"{arguments.out}: trained for {trainer.step} steps{before}")
    if held_out:
        given = ["--data", arguments.data[0], "--checkpoint", arguments.out, "--method", method]
        given += [] if arguments.support is None else ["--support", arguments.support]
        given += ["--legacy"] * arguments.legacy
        console.say(f"next: {command_line('hyperplanes', 'evaluate', given)}")
    return 0
