"""Run the whole method at a small scale: generate cars, train, render new views of held-out cars, and write a page.

Before that, the packaged model renders objects without training; the result is first.html. The command takes minutes on
two cores. It writes everything to --out: the data sets, the checkpoints, metrics.json and report.html. After an
interruption, run the same command again: it does only what is not done yet.

Example:
    hyperplanes demo
    hyperplanes demo --class chair --out runs/chairs
    hyperplanes demo --first-only --meshes my-models
    hyperplanes demo --quick-check --out runs/check
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hyperplanes.commands.options import Exists, OptionalFolder, OptionalInt
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import writes_to
from hyperplanes.commands.runs import count_workers, make_runner, make_workers
from hyperplanes.utilities.messages.formatting import format_duration

if TYPE_CHECKING:
    from hyperplanes.experiments.demonstration.settings import DemoSettings
    from hyperplanes.experiments.engine import OnScore, Runner
    from hyperplanes.experiments.paper.scales import Scale
    from hyperplanes.experiments.workspace import Workspace

__all__ = ["Arguments", "run", "settings_of"]

RESUMES = True  # the same command continues an interrupted one


@dataclass(frozen=True)
class Arguments:
    """The options of `demo`.

    Attributes:
        out: The folder for all results.
        class_name: The class of the procedural objects.
        objects: The number of objects, including the held-out ones.
        held_out: The number of objects that are kept out of training.
        resolution: Pixels along a side of the images.
        preset: The configuration that is trained; see `hyperplanes presets`.
        steps: Training steps. The default is small, so that everything takes minutes on two cores.
        meshes: A folder with a few mesh files, which the packaged model renders too, before anything is trained.
        first_only: Stop after the page of the packaged model.
        seed: The seed of the data, the trainings and the evaluation.
        workers: Processes that train and evaluate side by side, with one thread each. By default one per core, at most
            four, and one on a GPU. The last digits of fine-tuned scores may differ from those of a single process.
        quick_check: Only check that everything runs, with a few tiny objects and networks too small to learn.
        device: auto, cpu or cuda.
    """

    out: Path = Path("runs/demo")
    class_name: Annotated[Literal["car", "chair", "plane", "lamp"], tyro.conf.arg(name="class")] = "car"
    objects: int = 155
    held_out: int = 5
    resolution: int = 64
    preset: str = "quick"
    steps: Annotated[int, range(1, 10**10)] = 800
    meshes: Annotated[OptionalFolder, Exists("a folder of mesh files", folder=True)] = None
    first_only: bool = False
    seed: int = 0
    workers: OptionalInt = None
    quick_check: bool = False
    device: str = "auto"


def settings_of(arguments: Arguments) -> DemoSettings:
    """The settings of the demonstration.

    Raises:
        ValueError: too few objects or pixels, or options that --quick-check sets.
    """
    from hyperplanes.configuration.presets import preset
    from hyperplanes.experiments.demonstration.settings import DemoSettings

    if arguments.quick_check:
        usual = Arguments()
        for name in ("objects", "held_out", "resolution", "preset", "steps"):
            if getattr(arguments, name) != getattr(usual, name):
                option = f"--{name.replace('_', '-')}"
                raise ValueError(f"{option}: expected none with --quick-check, which sets its own; leave it out")
        small = DemoSettings.quick_check(arguments.seed)
        return replace(small, meshes=arguments.meshes, class_name=arguments.class_name)
    if not 1 < arguments.held_out < arguments.objects:
        raise ValueError(
            "expected --held-out above 1, so that updates can be swapped, and below --objects, "
            f"got {arguments.held_out} and {arguments.objects}"
        )
    if arguments.resolution < 16:
        raise ValueError(f"--resolution: expected at least 16 pixels, got {arguments.resolution}")
    preset(arguments.preset)  # a wrong name is found before anything is made
    given = {each.name for each in fields(DemoSettings)} & {each.name for each in fields(Arguments)}
    return DemoSettings(**{name: getattr(arguments, name) for name in given})


@writes_to(lambda arguments: arguments.out)
def run(arguments: Arguments) -> int:
    """Do all steps that are not done yet, and print the table."""
    from hyperplanes.experiments.demonstration.steps import Demonstration

    console, settings = Console(), settings_of(arguments)
    heading, begun = "", False

    def begin() -> None:  # called only if something of the step is not done yet
        nonlocal begun
        if not begun:
            console.say(heading)
        begun = True

    @contextmanager
    def evaluating(title: str) -> Generator[OnScore]:
        with console.bar(title) as bar:
            yield lambda cell, seed, score, done, total: bar.show(done, total, f"{score.name} {score.psnr:.2f} dB")

    asked = 1 if arguments.quick_check and arguments.workers is None else arguments.workers
    count = count_workers(asked, arguments.device)
    with ExitStack() as stack:

        def runner(workspace: Workspace, scale: Scale) -> Runner:
            workers = make_workers(count, workspace.out, scale, arguments.device)
            if workers is not None:
                stack.enter_context(workers)
            return make_runner(
                workspace, scale, console=console, device=arguments.device, announce=lambda line: None, workers=workers
            )

        demonstration = Demonstration(settings, arguments.out, runner, begin, console.say, evaluating)
        steps = list(demonstration.steps().items())[: 1 if arguments.first_only else None]
        for number, (name, work) in enumerate(steps, 1):
            heading, begun = f"[{number}/{len(steps)}] {name}", False
            work()
            if not begun:
                console.say(f"{heading}: done before")
    if not arguments.first_only:
        _finish(arguments.out, console)
    return 0


def _finish(out: Path, console: Console) -> None:
    from hyperplanes.experiments.demonstration.settings import describe_row
    from hyperplanes.utilities.files.checkpoints import read_json

    metrics = read_json(out / "metrics.json")
    rows = [
        (describe_row(name), f"{each['psnr']:.2f} dB", f"{each['ssim']:.3f}", format_duration(each["adapt_seconds"]))
        for name, each in sorted(metrics.items(), key=lambda pair: pair[1]["psnr"])
    ]
    console.table(("held-out objects, new views", "PSNR", "SSIM", "to adapt"), rows)
    console.say(f"the page: {(out / 'report.html').resolve().as_uri()}")
