"""Train a model on a data set that `generate` wrote, or on any other layout that `inspect` can read.

The model is evaluated on held-out objects at intervals. Checkpoints are written to --out during the training; to resume
an interrupted training from the last one, run the same command again. Ctrl-C stops after a checkpoint is written, as
does the SIGTERM of a cluster; a second Ctrl-C stops immediately. Beside the weights, --out has config.yaml (for the
option --config), curve.csv, samples/ with held-out views beside the true images, and best/ with the model that had the
highest PSNR on held-out objects.

With --devices N, N processes on this machine share the objects of every step, one per GPU; with --nodes M, N processes
on each of M machines do. If torchrun starts this command, its processes are used.

Every setting of the model and of the training is an option too, such as --training.learning-rate 1e-3. To see all of
them with their values, as a file for --config, run `hyperplanes presets quick`.

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
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hyperplanes.commands.options import (
    DATA_SET,
    Exists,
    OptionalFile,
    OptionalFolder,
    OptionalInt,
    OptionalName,
    OptionalNumber,
    Protocol,
)
from hyperplanes.commands.output.console import Bar, Console
from hyperplanes.commands.output.writing import refuse_foreign, writes_to
from hyperplanes.utilities.machine.interrupts import SIGNALS, HungUp, listened_to
from hyperplanes.utilities.machine.processes import is_first_process
from hyperplanes.utilities.messages.formatting import counted, format_duration, format_rate
from hyperplanes.utilities.messages.shell import command_line

if TYPE_CHECKING:
    from hyperplanes.configuration.presets import Preset
    from hyperplanes.training import Progress, Trainer
    from hyperplanes.training.monitoring import TensorBoard
    from hyperplanes.views import Tasks

__all__ = ["Arguments", "follow", "progress_line", "resolve", "run"]


BROUGHT = {"Fields": "hyperplanes.fields"}
"""Groups of entry points whose names are fields and methods, by their heading in the help."""

RESUMES = True  # the same command continues an interrupted one

SAME = {
    "steps": ("training.steps", "training.epochs"),
    "epochs": ("training.epochs", "training.steps"),
    "seed": ("training.seed",),
    "cache_size": ("training.memory",),
    "support": ("model.network.planes",),
    "field": ("model.target",),
    "protocol": ("model.protocol",),
}
"""The settings that an option sets, too."""


@dataclass(frozen=True)
class Arguments:
    """The options of `train`.

    Attributes:
        data: The data set, or several data sets whose objects are drawn with equal probability.
        out: The folder for checkpoints. A training that was interrupted there is resumed.
        config: A YAML file with all or some of the settings, such as the config.yaml of another training.
        preset: The preset with all other settings; see `hyperplanes presets`. By default that of --config, or quick.
        method: hyperplanes; a target network alone with one set of weights for all objects: point_multiplane,
            multiplane, nerf, image_based, or a field of another package; autoencoder; or a learned initialisation:
            mv_meta, sv_meta (Reptile from many views or a single one), maml, maml_first_order, mv_matched (random
            weights matched to mv_meta).
        field: The target network: nerf, multiplane, point_multiplane, image_based, simplified_nerf, or that of another
            package. By default that of the preset, and for learned initialisations NeRF.
        support: Support views and ImagePlanes per object. If the data set has fewer, query views are added.
        checkpoint: The initial weights instead of random ones: a checkpoint, or a packaged model such as small, whose
            learned steps and gating network are kept. For mv_matched, the checkpoint of mv_meta that it is matched to.
        protocol: How rays are sampled: paper takes 64 + 128 samples on every ray, ray_marching takes samples only in
            occupied space, default is as in the preset.
        steps: Training steps. By default those of the preset.
        epochs: Instead of steps: how often each object is drawn, on average.
        seed: The seed of the initial weights and of every random draw.
        cache_size: Memory in GiB for prepared objects, and as much again for their decoded images. By default 2.
        legacy: The principal point of learnit's and the paper's own files is at W / 2 at integer pixel centres.
        tensorboard: Write event files for TensorBoard to --out/tensorboard.
        device: auto, cpu or cuda.
        devices: Processes on this machine that share the objects of every step: one per GPU, or several on the CPU.
        nodes: Machines that share the objects of every step. Run the same command on each, with MASTER_ADDR,
            MASTER_PORT and NODE_RANK in its environment. All of them must have access to the folder --out.
    """

    data: Annotated[tuple[Path, ...], DATA_SET]
    out: Path
    config: Annotated[OptionalFile, Exists("a YAML file of settings")] = None
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
    """A line with the loss, the PSNR on held-out objects, the speed and the time left.

    Args:
        progress: the progress at this step.
        best: the PSNR to show if this step had no validation.
    """
    quality = progress.psnr if progress.psnr is not None else best
    held_out = f"held-out {quality:5.2f} dB" if quality is not None else "held-out    -    "
    return (
        f"loss {progress.loss:.4f}  {held_out}  {format_rate(progress.rays_per_second):>6} rays/s  "
        f"{format_duration(progress.seconds_left)} left"
    )


@contextmanager
def _stopping_on_signals(trainer: Trainer, bar: Bar) -> Generator[list[type[KeyboardInterrupt]]]:
    """A context in which the first Ctrl-C, SIGTERM or SIGHUP ends the training after its step, and a second at once.

    A terminal that is closed sends SIGHUP more than once; it counts once.

    Yields:
        The exceptions of the signals that were received.
    """
    heard: list[type[KeyboardInterrupt]] = []

    def note(number: int, _: object) -> None:
        if number == signal.SIGHUP and HungUp in heard:
            return
        heard.append(SIGNALS[number])
        if len(heard) > 1:
            raise heard[-1]
        trainer.stopping = True
        bar.warn(f"{signal.Signals(number).name}: stopping after this step; send it again to stop at once")

    before = {number: signal.signal(number, note) for number in listened_to()}
    try:
        yield heard
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def follow(trainer: Trainer, bar: Bar, board: TensorBoard | None = None) -> None:
    """Train to the end and show the progress.

    After Ctrl-C, a checkpoint is written and KeyboardInterrupt is raised with advice as its text; after SIGTERM it is
    `Terminated`, and after SIGHUP `HungUp`.

    Args:
        trainer: a trainer at any step.
        bar: shows a line for each report.
        board: receives every report as well.
    """
    from hyperplanes.adaptation.diagnostics import SMALLEST_SPREAD

    quality = None
    with _stopping_on_signals(trainer, bar) as heard:
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
                        f"{SMALLEST_SPREAD:.0%} of their norm: the hypernetwork predicts the same update for every "
                        "object; see docs/hypernetwork.md for options that prevent it"
                    )
            bar.show(progress.step, progress.steps, line, important=progress.psnr is not None)
    if trainer.stopping and trainer.processes.first:
        advice = f"step {trainer.step} is saved; run the same command again to resume from there"
        raise heard[0](advice) if heard else KeyboardInterrupt(advice)


def resolve(arguments: Arguments) -> Preset:
    """The configuration of the model and its training: the preset, changed by the file, the options and the settings.

    Raises:
        ValueError: an unknown name, or an invalid value; the message names the file or the option.
    """
    from hyperplanes.configuration.presets import TRAINABLE, preset
    from hyperplanes.configuration.settings_file import changed, parse_options, read_experiment
    from hyperplanes.utilities.files.settings import SettingsError
    from hyperplanes.utilities.messages.errors import prefix_errors

    given = read_experiment(arguments.config) if arguments.config else {}
    try:
        stated = parse_options(arguments.settings)
    except SettingsError as error:
        raise ValueError(f"--{error.path.replace('_', '-')}: {error.problem}") from None
    _refuse_both(arguments, stated)
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
        if "steps" in (training := stated.get("training", {})):
            training["epochs"] = 0
        chosen = changed(chosen, stated)
    except SettingsError as error:
        raise ValueError(f"--{error.path.replace('_', '-')}: {error.problem}") from None
    if arguments.support is not None:
        with prefix_errors("--support"):
            network = replace(chosen.model.network, planes=arguments.support)
            chosen = replace(chosen, model=replace(chosen.model, network=network))
    if arguments.method in TRAINABLE and chosen.model.method != arguments.method:
        raise ValueError(
            f"--method {arguments.method}: expected --model settings of this method, got those of "
            f"{chosen.model.method}; leave one out"
        )
    return chosen


def _refuse_both(arguments: Arguments, stated: Mapping[str, Any]) -> None:
    """Refuse two options for the same setting, of which one would be ignored.

    Args:
        arguments: the options of the verb.
        stated: the entries of its options with dots.

    Raises:
        ValueError: such a pair.
    """
    options = [name for name in SAME if getattr(arguments, name) not in (None, "default")]
    settings = _names(stated) - ({"training.epochs"} if not stated.get("training", {}).get("epochs") else set())
    both = [(name, setting) for name in options for setting in SAME[name] if setting in settings]
    for lengths in (options, settings):
        names = [name for name in ("steps", "epochs", "training.steps", "training.epochs") if name in lengths]
        both += [names] if len(names) == 2 else []
    if both:
        pair = ", ".join(f"--{name.replace('_', '-')}" for name in both[0])
        raise ValueError(f"{pair}: expected one of the two, got both; leave one out")


def _names(stated: Mapping[str, Any], before: str = "") -> set[str]:
    """The names of nested entries, with dots."""
    found = set()
    for name, value in stated.items():
        found |= _names(value, f"{before}{name}.") if isinstance(value, Mapping) else {before + name}
    return found


def _is_first(arguments: Arguments) -> bool:
    return is_first_process(arguments.devices * arguments.nodes)


@writes_to(lambda arguments: arguments.out, _is_first)
def run(arguments: Arguments) -> int:
    """Train from the start, or resume an interrupted training."""
    from hyperplanes.training.parallel.distributed import ProcessEnded

    try:
        return _run(arguments)
    except ProcessEnded:
        if _is_first(arguments):
            raise
        return 0  # the process that ended first has printed the reason


def _opened(arguments: Arguments, chosen: Preset, console: Console) -> Tasks:
    """The objects to train on and those held out, with the requested number of support views."""
    from hyperplanes.data.dataset import open_datasets
    from hyperplanes.data.support import WithSupport

    data = open_datasets(arguments.data, chosen.training.memory, legacy=arguments.legacy)
    for line in data.skipped:
        console.warn(line)
    if not data.names("train"):
        others = counted(len(data.names()), "object")
        raise ValueError(
            f"{' '.join(map(str, arguments.data))}: expected objects to train on, found none in its train split and "
            f"{others} in the others; scenes without a split can only be rendered or evaluated, and `hyperplanes "
            "generate` makes a data set with one"
        )
    if arguments.support is not None and chosen.training.views:
        raise ValueError(
            "--support: expected none, because training.views sets the number of support views; use --training.views"
        )
    return data if arguments.support is None else WithSupport(data, arguments.support)


def _run(arguments: Arguments) -> int:
    from hyperplanes.adaptation.checkpoints import find_checkpoints
    from hyperplanes.configuration.settings_file import write_experiment
    from hyperplanes.data.devices import choose_device
    from hyperplanes.training import start_training
    from hyperplanes.training.episodes.loader import reference_objects
    from hyperplanes.training.monitoring import TensorBoard
    from hyperplanes.training.parallel.distributed import check_shares
    from hyperplanes.training.parallel.launching import count_processes, launched

    if arguments.out.resolve() in {path.resolve() for path in arguments.data}:
        raise ValueError(f"--out: expected a folder of its own, got {arguments.out}, which is --data; name another one")
    first = _is_first(arguments)
    if first:
        refuse_foreign(arguments.out)
    console = Console(silent=not first)
    chosen = resolve(arguments)
    method = chosen.model.method
    tasks = _opened(arguments, chosen, console)
    reference = None
    if arguments.checkpoint is not None:
        reference = arguments.checkpoint
        if method == "mv_matched":
            reference = find_checkpoints([reference]).get("mv_meta", reference)
    processes = count_processes(arguments.devices, arguments.nodes)
    objects = reference_objects(chosen.model, chosen.training)
    check_shares(chosen.training.tasks, objects, processes[0] * processes[1])
    held_out = len(tasks.names("test"))
    with launched(*processes, choose_device(arguments.device)) as device:
        trainer = start_training(chosen.model, chosen.training, tasks, arguments.out, device, reference)
        begun = trainer.step
        if first:
            write_experiment(arguments.out / "config.yaml", chosen)
        shared = f", shared by {trainer.processes.count} processes" if trainer.processes.count > 1 else ""
        console.say(
            f"{method}: {sum(p.numel() for p in trainer.model.parameters()):,} weights, "
            f"{counted(len(trainer.loader.names), 'object')} to train on, {held_out} held out{shared}"
        )
        if trainer.step:
            console.say(f"resuming from step {trainer.step}")
        watched = arguments.tensorboard and first
        board = TensorBoard(arguments.out / "tensorboard", trainer.step) if watched else None
        try:
            with console.bar("training") as bar:
                follow(trainer, bar, board)
        finally:
            if board is not None:
                board.close()
    more, asked = begun > trainer.config.steps, trainer.config.steps
    before = f" before; nothing was trained now, because the settings ask for {asked}" if more else ""
    console.say(f"{arguments.out}: trained for {trainer.step} steps{before}")
    if held_out:
        given = ["--data", arguments.data[0], "--checkpoint", arguments.out, "--method", method]
        given += [] if arguments.support is None else ["--support", arguments.support]
        given += ["--legacy"] * arguments.legacy
        console.say(f"next: {command_line('hyperplanes', 'evaluate', given)}")
    return 0
