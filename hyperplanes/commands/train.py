"""Train a model on a data set; what `generate` writes, or any other layout that `inspect` can read.

The model is looked at on held-out objects now and then. Checkpoints are written to --out on the way; interrupted, the
same command goes on from the last one. Pressing Ctrl-C once stops after a checkpoint, twice at once.

Example:
    hyperplanes train --data data/cars --preset quick --out runs/cars
    hyperplanes train --data data/cars --preset quick --method point_multiplane --out runs/cars-baseline
    hyperplanes train --data data/cars --preset quick --method mv_meta --field nerf --out runs/cars-meta
"""

from __future__ import annotations

import signal
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hyperplanes.commands.console import Bar, Console
from hyperplanes.commands.options import OptionalField, OptionalFolder, OptionalInt, Protocol, Trainable
from hyperplanes.formatting import format_duration, format_rate

if TYPE_CHECKING:
    from hyperplanes.training import Progress, Trainer

__all__ = ["Arguments", "follow", "progress_line", "run"]


@dataclass(frozen=True)
class Arguments:
    """What to train, and on what.

    Attributes:
        data: The data set, or several whose objects are drawn alike.
        out: The folder for checkpoints; a training that was interrupted there goes on.
        preset: One of `hyperplanes presets`: how large the model is and how long it is trained.
        method: HyperPlanes, a target network alone with one set of weights for all objects, an autoencoder, or a
            learned initialisation (Reptile from many views or a single one, MAML, or random weights matched to one).
        field: Which target network: the preset's, or for learned initialisations NeRF, when not given.
        support: Support views and ImagePlanes an object; more than there are go on with the query views.
        checkpoint: What mv_matched is to match: a checkpoint of mv_meta.
        protocol: How rays are sampled: as the preset says, or 64 + 128 times each as in the paper.
        steps: Other than the preset's.
        seed: Of the first weights and of every draw.
        device: auto, cpu or cuda.
    """

    data: tuple[Path, ...]
    out: Path
    preset: str = "quick"
    method: Trainable = "hyperplanes"
    field: OptionalField = None
    support: OptionalInt = None
    checkpoint: OptionalFolder = None
    protocol: Protocol = "default"
    steps: OptionalInt = None
    seed: int = 0
    device: str = "auto"


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
def _polite_interrupt() -> Generator[list[int]]:
    """The first Ctrl-C is only noted, the second one is a KeyboardInterrupt."""
    noted: list[int] = []

    def note(number: int, _: object) -> None:
        if noted:
            raise KeyboardInterrupt
        noted.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


def follow(trainer: Trainer, bar: Bar) -> None:
    """Train to the end and show how it goes.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with a checkpoint written and advice as its text.
    """
    from hyperplanes.adaptation.diagnostics import SMALLEST_SPREAD

    quality = None
    with _polite_interrupt() as interrupted:
        warned = False
        for progress in trainer.run():
            quality = progress.psnr if progress.psnr is not None else quality
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
            if interrupted and progress.step < progress.steps:
                trainer.save()
                raise KeyboardInterrupt(f"step {progress.step} is saved, the same command goes on from there")


def run(arguments: Arguments) -> int:
    """Train, from the start or from where it was interrupted."""
    from hyperplanes.adaptation.pretrained import find_checkpoints
    from hyperplanes.data.dataset import open_datasets
    from hyperplanes.devices import choose_device
    from hyperplanes.presets import configure
    from hyperplanes.support import WithSupport
    from hyperplanes.training import start_training

    console = Console()
    chosen = configure(
        arguments.preset,
        arguments.method,
        steps=arguments.steps,
        seed=arguments.seed,
        protocol=arguments.protocol,
        target=arguments.field,
    )
    data, shown = open_datasets(arguments.data), " ".join(map(str, arguments.data))
    if not data.names("train"):
        raise ValueError(
            f"{shown}: expected objects to train on, found none in its train split; "
            "a single scene can only be rendered or evaluated"
        )
    model, tasks = chosen.model, data
    if arguments.support is not None:
        model = replace(model, network=replace(model.network, planes=arguments.support))
        tasks = WithSupport(data, arguments.support)
    reference = None
    if arguments.checkpoint is not None:
        reference = find_checkpoints([arguments.checkpoint]).get("mv_meta", arguments.checkpoint)
    device = choose_device(arguments.device)
    trainer = start_training(model, chosen.training, tasks, arguments.out, device, reference)
    held_out = len(data.names("test"))
    console.say(
        f"{arguments.method}: {sum(p.numel() for p in trainer.model.parameters()):,} weights, "
        f"{len(trainer.names)} objects to train on, {held_out} held out"
    )
    if trainer.step:
        console.say(f"going on from step {trainer.step}")
    with console.bar("training") as bar:
        follow(trainer, bar)
    console.say(f"{arguments.out}: trained for {trainer.step} steps")
    if held_out:
        method = arguments.method
        console.say(
            f"next: hyperplanes evaluate --data {arguments.data[0]} --checkpoint {arguments.out} --method {method}"
        )
    return 0
