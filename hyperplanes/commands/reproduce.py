"""Reproduce a table or a figure of the HyperPlanes paper and print it beside the paper's numbers.

The scale `smoke` takes seconds and shows that everything runs. `small` makes all ten tables in some hours on one core,
with procedural objects of 32x32 pixels from `hyperplanes generate`. `gpu` is sized for all ten in about a day on one
GPU, and `paper` has the paper's settings. Both need the published data sets, one folder per class, and first print how
long they will take, from steps measured on this machine; --estimate does so for any scale. All tables share --out, and
no data set, training or evaluation there is made twice. To resume after Ctrl-C, run the same command again. The table
is written to --out/NAME as Markdown, CSV and JSON, with its figures.

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

from hyperplanes.commands.options import OptionalInt
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import writes_to
from hyperplanes.commands.runs import make_runner, make_workers
from hyperplanes.utilities.messages.shell import command_line

if TYPE_CHECKING:
    from hyperplanes.evaluation import ObjectScore
    from hyperplanes.experiments.engine import Outcome, Runner
    from hyperplanes.experiments.paper.experiment import Cell

__all__ = ["Arguments", "data_sets", "run"]

BROUGHT = {"Tables": "hyperplanes.tables"}
"""Groups of entry points whose names are tables, by their heading in the help."""

RESUMES = True  # the same command continues an interrupted one


@dataclass(frozen=True)
class Arguments:
    """The options of `reproduce`.

    Attributes:
        name: The table or figure of the paper: shapenet, cross-class, target, time, single-class, iterations,
            hyperplanes, imageplanes, inputs or layers; or a table of another installed package.
        scale: The scale of the experiment: the size of data and models, and the number of steps and seeds.
        out: The folder for data, trainings, evaluations and tables. All tables share it.
        data: Data sets by class, such as car=FOLDER, in any layout. Classes that are not given are generated.
        only: Run only the rows and columns with these headings, such as Cars. By default all of them.
        seeds: The number of seeds. A seed is used for a training and for the fine-tuning of its evaluations. By default
            that of the scale.
        legacy: The principal point of learnit's and the paper's own files is at W / 2 at integer pixel centres.
        workers: Processes that train and evaluate side by side, with one thread each. The last digits of fine-tuned
            scores may differ from those of a single process. Times are always measured by one process alone.
        estimate: Only measure a few steps of every training, and print how long everything will take on this machine.
        device: auto, cpu or cuda.
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
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
    """The folders of data sets by class.

    Args:
        given: strings of the form CLASS=FOLDER.
        classes: the known classes.

    Raises:
        ValueError: another form, an unknown class, one class twice, or no such folder.
    """
    found: dict[str, Path] = {}
    for each in given:
        name, _, folder = each.partition("=")
        if not folder or name not in classes or name in found:
            known = ", ".join(classes)
            raise ValueError(f"--data: expected CLASS=FOLDER, each of the classes {known} once, got {each!r}")
        found[name] = Path(folder)
    for name, folder in found.items():
        if not folder.is_dir():
            what = "a file" if folder.exists() else "nothing"
            raise ValueError(f"--data {name}={folder}: expected the folder of a data set, found {what}; check the path")
    return found


@writes_to(lambda arguments: arguments.out)
def run(arguments: Arguments) -> int:
    """Run everything that is not done yet and print the table."""
    from hyperplanes.experiments import SCALES, find_experiment, report
    from hyperplanes.experiments.configurations import DIFFERENCE_HEADINGS
    from hyperplanes.experiments.estimate import estimate
    from hyperplanes.experiments.paper.tables import CLASS_OF_COLUMN
    from hyperplanes.experiments.workspace import Workspace
    from hyperplanes.utilities.messages.formatting import format_duration

    console = Console()
    scale = SCALES[arguments.scale]
    table = scale.applied(find_experiment(arguments.name))
    experiment = table.of(arguments.only)
    seeds = scale.seeds(experiment) if arguments.seeds is None else arguments.seeds
    if seeds < 1:
        raise ValueError(f"--seeds: expected at least 1, got {seeds}")
    if arguments.legacy and not arguments.data:
        raise ValueError("--legacy: expected --data as well, got none; generated data sets are read in one way only")

    def found(cell: Cell, seed: int, score: ObjectScore, *_: int) -> None:
        console.say(f"{cell.row}, {cell.column}, seed {seed}: {score.name} {score.psnr:.2f} dB")

    given = data_sets(arguments.data, dict.fromkeys([*CLASS_OF_COLUMN.values(), *table.classes]))
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
    names = _write(folder, _command(arguments, seeds), outcome, runner)
    console.say(f"{experiment.title}; HyperPlanes (arXiv 2402.01524), {experiment.where}")
    console.table(report.headings(outcome), report.rows(outcome))
    for line in report.what_differs(outcome):
        console.say(f"- {line}")
    if settings := report.settings(outcome):
        console.table(DIFFERENCE_HEADINGS, settings)
        for line in report.sources():
            console.say(f"- {line}")
    console.say(f"{folder}: {', '.join(names)}")
    return 0


def _write(folder: Path, command: str, outcome: Outcome, runner: Runner) -> list[str]:
    """Write the table and its figures; returns the names of the files."""
    from hyperplanes.experiments import report
    from hyperplanes.experiments.figures import curves_of, figure_of, pictures_of
    from hyperplanes.utilities.files.writing import write_json, write_whole
    from hyperplanes.utilities.images.plots import save_figure

    write_json(folder / "results.json", report.as_json(outcome, command))
    write_whole(folder / "table.csv", report.as_csv(outcome).encode())
    made = {"figure": figure_of(outcome), "curves": curves_of(outcome), "pictures": pictures_of(runner, outcome)}
    names = {f"{name}.png": figure for name, figure in made.items() if figure is not None}
    for name, figure in names.items():
        save_figure(figure, folder / name)
    write_whole(folder / "table.md", report.as_markdown(outcome, command, [*names]).encode())
    return ["table.md", "table.csv", "results.json", *names]


def _command(arguments: Arguments, seeds: int) -> str:
    scale = ["--scale", arguments.scale, "--seeds", seeds]
    only = ["--only", *arguments.only] if arguments.only else []
    data = ["--data", *arguments.data] if arguments.data else []
    return command_line("hyperplanes", "reproduce", arguments.name, scale, only, ["--legacy"] * arguments.legacy, data)
