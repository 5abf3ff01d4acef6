"""Run a table or a figure of the HyperPlanes paper and print it beside the paper's numbers.

The scale `smoke` takes seconds and shows that everything runs; `small` makes all ten tables in some hours on one core,
on procedural objects of 32x32 pixels that `hyperplanes generate` makes; `gpu` is sized for all ten in about a day
on one card, and `paper` is the paper's setting, both on data sets as they were published, one folder a class. These two
say first how long they will take by what they have measured here, as --estimate does for any. All tables share --out: a
data set, a training or an evaluation that lies there is not made again, so Ctrl-C and the same command go on. The table
goes to --out/NAME as Markdown, CSV and JSON with its figures.

Example:
    hyperplanes reproduce target --scale smoke
    hyperplanes reproduce cross-class --scale small --out runs/reproduce
    hyperplanes reproduce shapenet --scale paper --data car=shapenet/cars chair=shapenet/chairs lamp=shapenet/lamps
    hyperplanes reproduce shapenet --scale gpu --legacy --data car=shapenet/cars ... --estimate
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import OptionalInt
from hyperplanes.commands.runs import make_runner, make_workers
from hyperplanes.commands.writing import writes_to
from hyperplanes.utilities.shell import command_line

if TYPE_CHECKING:
    from hyperplanes.evaluation import ObjectScore
    from hyperplanes.experiments.experiment import Cell

__all__ = ["Arguments", "data_sets", "run"]

BROUGHT = {"Tables": "hyperplanes.tables"}
"""Groups of entry points whose names are tables."""


@dataclass(frozen=True)
class Arguments:
    """Which table, how large, and where to.

    Attributes:
        name: The table or figure of the paper: shapenet, cross-class, target, time, single-class, iterations,
            hyperplanes, imageplanes, inputs or layers; or a table of another installed package.
        scale: How large.
        out: The folder for data, trainings, evaluations and tables, shared by all of them.
        data: Data sets by class, such as car=FOLDER, in any layout; what is not given is generated.
        only: Rows and columns by their headings, such as Cars; all where empty.
        seeds: Other than the scale's: seeds of trainings and of the fine-tuning of their evaluations.
        legacy: Read the principal points of published data at W / 2 at integer pixel centres, as the code published
            with them has it.
        workers: Processes that train and evaluate side by side, with one thread each, by which fine-tuned scores may
            differ in their last digits from those of one process; times are measured by one alone.
        estimate: Only measure a few steps of every training and say how long all will take here.
        device: auto, cpu or cuda.
    """

    name: tyro.conf.Positional[str]
    scale: Literal["smoke", "small", "gpu", "paper"] = "small"
    out: Path = Path("runs/reproduce")
    data: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    seeds: OptionalInt = None
    legacy: bool = False
    workers: Annotated[int, range(1, 65)] = 1
    estimate: bool = False
    device: str = "auto"


def data_sets(given: Sequence[str], classes: Collection[str]) -> dict[str, Path]:
    """Folders by class.

    Args:
        given: of the form CLASS=FOLDER.
        classes: those that there are.

    Raises:
        ValueError: not of that form, another class, or one class twice.
    """
    found: dict[str, Path] = {}
    for each in given:
        name, _, folder = each.partition("=")
        if not folder or name not in classes or name in found:
            known = ", ".join(classes)
            raise ValueError(f"--data: expected CLASS=FOLDER, each of the classes {known} once, got {each!r}")
        found[name] = Path(folder)
    return found


@writes_to(lambda arguments: arguments.out)
def run(arguments: Arguments) -> int:
    """Run what is not done yet and print the table."""
    from hyperplanes.experiments import SCALES, find_experiment, report
    from hyperplanes.experiments.configurations import DIFFERENCE_HEADINGS
    from hyperplanes.experiments.estimate import estimate
    from hyperplanes.experiments.figures import curves_of, figure_of, pictures_of
    from hyperplanes.experiments.tables import CLASSES
    from hyperplanes.experiments.workspace import Workspace
    from hyperplanes.utilities.formatting import format_duration
    from hyperplanes.utilities.plots import save_figure
    from hyperplanes.utilities.writing import write_json, write_whole

    console = Console()
    scale = SCALES[arguments.scale]
    table = scale.applied(find_experiment(arguments.name))
    experiment = table.of(arguments.only)
    seeds = scale.seeds(experiment) if arguments.seeds is None else arguments.seeds
    if seeds < 1:
        raise ValueError(f"--seeds: expected at least 1, got {seeds}")

    def found(cell: Cell, seed: int, score: ObjectScore, *_: int) -> None:
        console.say(f"{cell.row}, {cell.column}, seed {seed}: {score.name} {score.psnr:.2f} dB")

    given = data_sets(arguments.data, dict.fromkeys([*CLASSES.values(), *table.classes]))
    device, legacy = arguments.device, arguments.legacy
    workers = make_workers(arguments.workers, arguments.out, scale, device, given=given, legacy=legacy)
    runner = make_runner(
        Workspace(arguments.out),
        scale,
        console=console,
        device=device,
        announce=console.say,
        workers=workers,
        given=given,
        legacy=legacy,
    )
    if arguments.estimate or scale.resolution is None:
        expected = estimate(runner, experiment, seeds)
        console.table(expected.headings, expected.rows)
        console.say(f"all of it: {format_duration(expected.seconds)} on this machine")
        if arguments.estimate:
            return 0
    with workers or nullcontext():
        outcome = runner.run(experiment, seeds, found)
    folder = arguments.out / experiment.name
    command = _command(arguments, seeds)
    write_json(folder / "results.json", report.as_json(outcome, command))
    write_whole(folder / "table.csv", report.as_csv(outcome).encode())
    made = {"figure": figure_of(outcome), "curves": curves_of(outcome), "pictures": pictures_of(runner, outcome)}
    names = {f"{name}.png": figure for name, figure in made.items() if figure is not None}
    for name, figure in names.items():
        save_figure(figure, folder / name)
    write_whole(folder / "table.md", report.as_markdown(outcome, command, [*names]).encode())
    console.say(f"{experiment.title}; HyperPlanes (arXiv 2402.01524), {experiment.where}")
    console.table(report.headings(outcome), report.rows(outcome))
    for line in report.what_differs(outcome):
        console.say(f"- {line}")
    if settings := report.settings(outcome):
        console.table(DIFFERENCE_HEADINGS, settings)
        for line in report.sources():
            console.say(f"- {line}")
    console.say(f"{folder}: {', '.join(['table.md', 'table.csv', 'results.json', *names])}")
    return 0


def _command(arguments: Arguments, seeds: int) -> str:
    scale = ["--scale", arguments.scale, "--seeds", seeds]
    only = ["--only", *arguments.only] if arguments.only else []
    data = ["--data", *arguments.data] if arguments.data else []
    return command_line("hyperplanes", "reproduce", arguments.name, scale, only, ["--legacy"] * arguments.legacy, data)
