"""Run a table or a figure of the HyperPlanes paper and print it beside the paper's numbers.

The scale `smoke` takes seconds and shows that everything runs; `small` is sized for two cores, one to a few hours each,
as --estimate says, on procedural objects that `hyperplanes generate` makes; `paper` is the paper's setting on data sets
as they were published, one folder a class, and says first how long it will take by what it has measured here. All
tables share --out: a data set, a training or an evaluation that lies there is not made again, so Ctrl-C and the same
command go on. The table goes to --out/NAME as Markdown, CSV and JSON with its figure.

Example:
    hyperplanes reproduce target --scale smoke
    hyperplanes reproduce cross-class --scale small --out runs/reproduce
    hyperplanes reproduce shapenet --scale paper --data car=shapenet/cars chair=shapenet/chairs lamp=shapenet/lamps
    hyperplanes reproduce shapenet --scale paper --data car=shapenet/cars ... --estimate
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import OptionalInt
from hyperplanes.commands.writing import writes_to

if TYPE_CHECKING:
    from hyperplanes.configuration.presets import Preset
    from hyperplanes.experiments.scales import Scale
    from hyperplanes.views import Tasks

__all__ = ["Arguments", "data_sets", "run"]

Name = Literal[
    "shapenet",
    "cross-class",
    "target",
    "time",
    "single-class",
    "iterations",
    "hyperplanes",
    "imageplanes",
    "inputs",
    "layers",
]


@dataclass(frozen=True)
class Arguments:
    """Which table, how large, and where to.

    Attributes:
        name: The table or figure of the paper.
        scale: How large.
        out: The folder for data, trainings, evaluations and tables, shared by all of them.
        data: Data sets by class, such as car=FOLDER, in any layout; what is not given is generated.
        seeds: Other than the scale's: seeds of trainings and of the fine-tuning of their evaluations.
        estimate: Only measure a few steps of every training and say how long all will take here.
        device: auto, cpu or cuda.
    """

    name: Annotated[Name, tyro.conf.Positional]
    scale: Literal["smoke", "small", "paper"] = "small"
    out: Path = Path("runs/reproduce")
    data: tuple[str, ...] = ()
    seeds: OptionalInt = None
    estimate: bool = False
    device: str = "auto"


def data_sets(given: Sequence[str]) -> dict[str, Path]:
    """Folders by class.

    Raises:
        ValueError: not of the form CLASS=FOLDER, or another class.
    """
    from hyperplanes.experiments.tables import CLASSES

    found = {}
    for each in given:
        name, equals, folder = each.partition("=")
        if not equals or name not in CLASSES.values():
            raise ValueError(
                f"--data: expected CLASS=FOLDER with a class of {', '.join(CLASSES.values())}, got {each!r}"
            )
        found[name] = Path(folder)
    return found


@writes_to(lambda arguments: arguments.out)
def run(arguments: Arguments) -> int:
    """Run what is not done yet and print the table."""
    from hyperplanes.commands.train import follow
    from hyperplanes.data.devices import choose_device
    from hyperplanes.experiments import EXPERIMENTS, SCALES, report
    from hyperplanes.experiments.engine import Runner
    from hyperplanes.experiments.estimate import estimate
    from hyperplanes.experiments.figures import figure_of
    from hyperplanes.training import start_training
    from hyperplanes.utilities.files import write_json, write_whole
    from hyperplanes.utilities.formatting import format_duration
    from hyperplanes.utilities.plots import save_figure

    console, device = Console(), choose_device(arguments.device)
    scale = SCALES[arguments.scale]
    experiment = scale.applied(EXPERIMENTS[arguments.name])
    seeds = scale.seeds(experiment) if arguments.seeds is None else arguments.seeds
    if seeds < 1:
        raise ValueError(f"--seeds: expected at least 1, got {seeds}")

    def train(method: str, chosen: Preset, data: Tasks, folder: Path, reference: Path | None) -> None:
        trainer = start_training(chosen.model, chosen.training, data, folder, device, reference)
        with console.bar(method) as bar:
            follow(trainer, bar)

    runner = Runner(
        arguments.out,
        scale,
        given=data_sets(arguments.data),
        generate=lambda name, folder: _generate(name, folder, scale),
        train=train,
        say=console.say,
        device=device,
    )
    if arguments.estimate or scale.name == "paper":
        found = estimate(runner, experiment, seeds)
        console.table(found.headings, found.rows)
        console.say(f"all of it: {format_duration(found.seconds)} on this machine")
        if arguments.estimate:
            return 0
    outcome = runner.run(experiment, seeds)
    folder = arguments.out / experiment.name
    command = _command(arguments, seeds)
    write_json(folder / "results.json", report.as_json(outcome, command))
    write_whole(folder / "table.md", report.as_markdown(outcome, command).encode())
    write_whole(folder / "table.csv", report.as_csv(outcome).encode())
    save_figure(figure_of(outcome), folder / "figure.png")
    console.say(f"{experiment.title}; HyperPlanes (arXiv 2402.01524), {experiment.where}")
    console.table(report.headings(outcome), report.rows(outcome))
    for line in report.what_differs(outcome):
        console.say(f"- {line}")
    console.say(f"{folder}: table.md, table.csv, results.json, figure.png")
    return 0


def _command(arguments: Arguments, seeds: int) -> str:
    data = f" --data {' '.join(arguments.data)}" if arguments.data else ""
    return f"hyperplanes reproduce {arguments.name} --scale {arguments.scale} --seeds {seeds}{data}"


def _generate(class_name: str, folder: Path, scale: Scale) -> None:
    from hyperplanes.commands import find_verb

    generate = find_verb("generate").load()
    generate.run(
        generate.Arguments(
            folder,
            class_name=class_name,
            count=scale.objects,
            held_out=scale.held_out,
            views=scale.views,
            resolution=scale.resolution,
        )
    )
