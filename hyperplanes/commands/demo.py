"""The whole method once, small: procedural cars, training, new views of cars it has never seen, and a page about it.

Before that, the packaged model shows what needs no training, in first.html. Takes minutes on two cores. Everything goes
to --out: the data sets, the checkpoints, metrics.json and report.html.
Interrupted, the same command goes on; run again, it does only what is not done yet.

Example:
    hyperplanes demo
    hyperplanes demo --class chair --out runs/chairs
    hyperplanes demo --first-only --meshes my-models
    hyperplanes demo --quick-check --out runs/check
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import OptionalFolder
from hyperplanes.commands.writing import writes_to
from hyperplanes.utilities.formatting import format_duration

if TYPE_CHECKING:
    from hyperplanes.experiments.demonstration.pipeline import DemoSettings
    from hyperplanes.experiments.stages import Stage, Stages

__all__ = ["Arguments", "run", "settings_of"]

MOST = 12  # objects on the first page


@dataclass(frozen=True)
class Arguments:
    """How large, and where to.

    Attributes:
        out: The folder for everything.
        class_name: Which procedural objects.
        objects: How many, the held-out ones included.
        held_out: How many of them are kept from training.
        resolution: Pixels along a side.
        preset: What is trained; see `hyperplanes presets`.
        steps: Training steps; so few that all is done in ten minutes on two cores.
        meshes: A folder with a few mesh files that the packaged model shows first, beside procedural objects.
        first_only: End after the packaged model's page.
        seed: Of everything.
        quick_check: Only see that everything runs: a few tiny objects and networks that learn nothing.
        device: auto, cpu or cuda.
    """

    out: Path = Path("runs/demo")
    class_name: Annotated[Literal["car", "chair", "plane", "lamp"], tyro.conf.arg(name="class")] = "car"
    objects: int = 155
    held_out: int = 5
    resolution: int = 64
    preset: str = "quick"
    steps: int = 800
    meshes: OptionalFolder = None
    first_only: bool = False
    seed: int = 0
    quick_check: bool = False
    device: str = "auto"


def settings_of(arguments: Arguments) -> DemoSettings:
    """The settings of the demonstration.

    Raises:
        ValueError: too few objects or pixels, or no folder of meshes.
    """
    from hyperplanes.experiments.demonstration.pipeline import DemoSettings

    if arguments.meshes is not None and not arguments.meshes.is_dir():
        found = "a file" if arguments.meshes.exists() else "nothing"
        what = f"got {arguments.meshes}, which is {found}"
        raise ValueError(f"--meshes: expected a folder of mesh files, {what}; check the path")
    if arguments.quick_check:
        return replace(DemoSettings.quick_check(arguments.seed), meshes=arguments.meshes)
    if not 1 < arguments.held_out < arguments.objects:
        raise ValueError(
            "expected --held-out above 1, so that updates can be swapped, and below --objects, "
            f"got {arguments.held_out} and {arguments.objects}"
        )
    if arguments.resolution < 16:
        raise ValueError(f"resolution: expected at least 16 pixels, got {arguments.resolution}")
    return DemoSettings(
        arguments.class_name,
        arguments.objects,
        arguments.held_out,
        arguments.resolution,
        preset=arguments.preset,
        steps=arguments.steps,
        seed=arguments.seed,
        meshes=arguments.meshes,
    )


@writes_to(lambda arguments: arguments.out)
def run(arguments: Arguments) -> int:
    """All stages, each skipped when it is done."""
    from hyperplanes.experiments.demonstration.pipeline import stages
    from hyperplanes.experiments.stages import Stages

    console, settings = Console(), settings_of(arguments)
    todo, record = stages(settings), Stages(arguments.out)
    todo = todo[:1] if arguments.first_only else todo
    for number, stage in enumerate(todo, 1):
        heading = f"[{number}/{len(todo)}] {stage.name}"
        if record.done(stage):
            console.say(f"{heading}: done before")
            continue
        console.say(heading)
        with record.work(stage):
            _work(stage, settings, arguments, console, record)
    if not arguments.first_only:
        _finish(arguments.out, console)
    return 0


def _work(stage: Stage, settings: DemoSettings, arguments: Arguments, console: Console, record: Stages) -> None:
    from hyperplanes.data import open_dataset
    from hyperplanes.experiments.demonstration.pipeline import FIRST, MODELS, configurations

    out = arguments.out
    if stage.name == FIRST:
        _show_first(settings, out, console)
        return
    if stage.name == "data":
        _generate(settings, out)
        return
    data = open_dataset(out / ("unseen" if ":" in stage.name else "data"))
    if stage.name in MODELS:
        _train(stage.name, configurations(settings)[stage.name], arguments, console)
    elif stage.name == "report":
        from hyperplanes.experiments.demonstration.pipeline import write_metrics
        from hyperplanes.experiments.demonstration.report import how_it_was_made, write_report

        facts = how_it_was_made(settings, out, data.manifest)
        write_report(out, data, settings, write_metrics(out, settings), facts)
    elif stage.name == "fine-tuning":
        from hyperplanes.experiments.demonstration.pipeline import measure_tuning

        measure_tuning(settings, data, out, lambda name, psnr: console.say(f"{name}: {psnr:.2f} dB"), arguments.device)
    else:
        from hyperplanes.experiments.demonstration.pipeline import score_method

        method, names = stage.name.removeprefix("evaluate "), data.names("test")
        with console.bar(method) as bar:
            done = 0

            def show(score) -> None:
                nonlocal done
                done += 1
                bar.show(done, len(names), f"{score.name} {score.psnr:.2f} dB")

            score_method(method, data, out, show, arguments.device)


def _show_first(settings: DemoSettings, out: Path, console: Console) -> None:
    """Objects that no training saw, and the page on which the packaged model shows them."""
    from hyperplanes.commands import find_verb
    from hyperplanes.data.dataset import open_datasets
    from hyperplanes.experiments.demonstration.first_page import write_first_page

    generate = find_verb("generate").load()
    sizes = {"resolution": settings.first_resolution, "rig": "random", "seed": settings.seed}
    folders = {out / "first" / name: {"class_name": name, "count": 1} for name in settings.first}
    if settings.meshes is not None:
        folders[out / "first" / "meshes"] = {"meshes": settings.meshes}
    for folder, what in sorted(folders.items(), key=lambda item: "meshes" not in item[1]):  # they may be wrong input
        generate.run(generate.Arguments(folder, held_out=1, **what, **sizes))
    data = open_datasets(list(folders))
    page = write_first_page(
        out / "first.html",
        data,
        data.names()[:MOST],
        settings.frames // 2,
        lambda name, psnr: console.say(f"{name}: {psnr:.2f} dB"),
        settings.first_counts,
    )
    console.say(f"the first page: {page.resolve().as_uri()}")


def _generate(settings: DemoSettings, out: Path) -> None:
    from hyperplanes.commands import find_verb

    generate = find_verb("generate").load()
    sizes = {name: getattr(settings, name) for name in ("seed", "views", "resolution")}
    unseen = settings.unseen_objects
    for folder, class_name, objects, held_out in (
        (out / "data", settings.class_name, settings.objects, settings.held_out),
        (out / "unseen", settings.unseen_class, unseen, unseen),
    ):
        generate.run(generate.Arguments(folder, class_name=class_name, count=objects, held_out=held_out, **sizes))


def _train(name: str, chosen, arguments: Arguments, console: Console) -> None:
    from hyperplanes.commands.train import follow
    from hyperplanes.data import open_dataset
    from hyperplanes.data.devices import choose_device
    from hyperplanes.training import start_training

    data = open_dataset(arguments.out / "data")
    trainer = start_training(chosen.model, chosen.training, data, arguments.out / name, choose_device(arguments.device))
    if trainer.step:
        console.say(f"going on from step {trainer.step}")
    with console.bar(name) as bar:
        follow(trainer, bar)


def _finish(out: Path, console: Console) -> None:
    from hyperplanes.experiments.demonstration.pipeline import describe_row
    from hyperplanes.utilities.checkpoints import read_json

    metrics = read_json(out / "metrics.json")
    rows = [
        (describe_row(name), f"{each['psnr']:.2f} dB", f"{each['ssim']:.3f}", format_duration(each["adapt_seconds"]))
        for name, each in sorted(metrics.items(), key=lambda pair: pair[1]["psnr"])
    ]
    console.table(("held-out objects, new views", "PSNR", "SSIM", "to adapt"), rows)
    console.say(f"the page: {(out / 'report.html').resolve().as_uri()}")
