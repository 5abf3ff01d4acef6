"""Compare methods on objects that none of them was trained on: PSNR and SSIM over the query views, as one table.

Every method runs through the same code: it gets the support views of an object, and its pictures of the query views are
compared with the images. The data set may be one that `generate` wrote or a single posed scene, such as a folder with
transforms.json.

A method's name may end in a number of fine-tuning steps on the support views of each object, or in _auto. With --steps,
every method that can be fine-tuned is evaluated at each of those numbers, and --curve draws its PSNR over them. A name
may be followed by @ and a checkpoint, to compare several checkpoints of one method in one table.

With --seeds N everything is done N times with the seeds 0 to N - 1, and the table has means and standard deviations
over them. The seed determines gradient steps on the support views, random weights, and the support views of --choose
random; {seed} in the name of a checkpoint stands for it. Methods are compared in pairs over the objects, by a paired
t-test.

Objects that cannot be read or adapted to are named and left out, for all methods, and the exit code is 1. While the
command runs, NAME.partial.json has the results so far; at the end, NAME.json of --json has all of them.

Example:
    hyperplanes evaluate --data data/cars --checkpoint runs/cars --method nearest_view hyperplanes hyperplanes_swapped
    hyperplanes evaluate --data data/cars --checkpoint runs/cars --method hyperplanes scratch --steps 10 100
    hyperplanes evaluate --data data/cars --method hull_blend hyperplanes@small hyperplanes@runs/cars
    hyperplanes evaluate --data data/cars --checkpoint small --support 3 --choose random --seeds 5
    hyperplanes evaluate --data data/cars --checkpoint runs/cars-{seed} --seeds 5 --markdown cars.md --boxes cars.png
    hyperplanes evaluate --data scene --method nearest_view hull_blend point_multiplane_scratch_300
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.options import (
    DATA_SET,
    Exists,
    Free,
    OptionalFile,
    OptionalInt,
    Protocol,
    ViewsUp,
    check_fine_tune,
    optional,
)
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.output.writing import check_output
from hyperplanes.utilities.messages.formatting import counted

if TYPE_CHECKING:
    import torch

    from hyperplanes.data import Dataset
    from hyperplanes.data.devices import TasksOnDevice
    from hyperplanes.evaluation import Score
    from hyperplanes.evaluation.comparison import Comparison
    from hyperplanes.methods import WithSampler
    from hyperplanes.views import Tasks, Views

__all__ = ["Arguments", "run", "with_seed"]

BROUGHT = {"Methods": "hyperplanes.methods", "Fields": "hyperplanes.fields"}
"""Groups of entry points whose names are methods."""

SEED, AT = "{seed}", "@"
LARGEST_TABLE = 12  # pairs shown in the terminal; all are in the files


@dataclass(frozen=True)
class Arguments:
    """The options of `evaluate`.

    Attributes:
        data: A data set or one posed scene; example-car comes with the package.
        method: nearest_view, hull_blend and hull_blend_reflected (nothing is learned); nerf, multiplane,
            point_multiplane, image_based, hyperplanes, hyperplanes_swapped (each object with the update of another),
            autoencoder; scratch_N (the field of a checkpoint from random weights), nerf_scratch_N,
            multiplane_scratch_N, point_multiplane_scratch_N (no checkpoint is needed); standard, mv_matched,
            mv_shuffled, mv_meta, sv_meta, maml, maml_first_order. All but the first three and hyperplanes_swapped may
            be followed by _N or _auto for gradient steps. NAME@CHECKPOINT evaluates that checkpoint.
        checkpoint: The checkpoints of methods without @: folders that `train` wrote, folders of them such as runs/demo,
            or a packaged model: small, small-paper, cars-64; {seed} stands for each seed.
        json: Write the table here too, with every object, every seed and every pair of methods.
        csv: Write the numbers of every object here, one line each.
        markdown: Write the tables of methods and of their pairs here.
        grid: Draw the truth beside every method's picture here: a view of each of the first objects (PNG, SVG or PDF).
        boxes: Draw the PSNR of the objects here, one box per method.
        steps: Evaluate methods after N fine-tuning steps, a row for each number; 0 is the method itself.
        curve: Draw PSNR over --steps into this file.
        fine_tune: What fine-tuning optimises: the weights theta + delta, or the hypernetwork while theta is frozen.
        seeds: How many seeds.
        lpips: Measure LPIPS with these weights, a safetensors file that `hyperplanes.evaluation.perceptual` describes.
        split: Which objects.
        objects: Evaluate only the first N objects.
        support: Number of support views of each object; by default all. If an object has fewer, query views are added,
            which are then compared although they were given; a warning says so.
        choose: Which views --support takes: the first ones of the data set, those whose cameras are farthest apart, or
            a random choice for each object and seed.
        inputs: Positions of the support views in the order of the views' names, from 0, such as 64 128 for SRN's
            protocol. All other views are query views.
        query: Compare only this number of query views of each object, evenly chosen.
        preset: The preset of fields that need no checkpoint.
        up: The direction that points up in the data's world: an axis such as y or -z, three numbers such as 0,0.1,1, or
            auto: of a single scene, from how its cameras are held; of a data set, as its files say, otherwise y as in
            training data.
        protocol: How fields are sampled: default, as in training; paper, 64 + 128 samples on each ray; or
            ray_marching, which takes samples only in occupied voxels.
        legacy: The principal point of learnit's and the paper's own files is at W / 2 at integer pixel centres.
        device: auto, cpu or cuda.
    """

    data: Annotated[Path, DATA_SET]
    method: tuple[str, ...] = ("nearest_view", "hyperplanes")
    checkpoint: tuple[Path, ...] = ()
    json: Annotated[Path | None, optional("FILE")] = None
    csv: Annotated[Path | None, optional("FILE")] = None
    markdown: Annotated[Path | None, optional("FILE")] = None
    grid: Annotated[Path | None, optional("FILE")] = None
    boxes: Annotated[Path | None, optional("FILE")] = None
    steps: tuple[int, ...] = ()
    curve: Annotated[Path | None, optional("FILE")] = None
    fine_tune: Free = "weights"
    seeds: int = 1
    lpips: Annotated[OptionalFile, Exists("a safetensors file of weights of LPIPS")] = None
    split: Literal["test", "val", "train", "all"] = "test"
    objects: OptionalInt = None
    support: OptionalInt = None
    choose: Literal["first", "farthest", "random"] = "first"
    inputs: tuple[int, ...] = ()
    query: OptionalInt = None
    preset: str = "quick"
    up: ViewsUp = "auto"
    protocol: Protocol = "default"
    legacy: bool = False
    device: str = "auto"


OUTPUTS = ("curve", "boxes", "grid", "csv", "markdown", "json")
"""Options that name files to write."""


def with_seed(folders: Sequence[Path], seed: int) -> list[Path]:
    """Checkpoints of one seed."""
    return [Path(str(folder).replace(SEED, str(seed))) for folder in folders]


def rows_of(method: str, steps: Sequence[int]) -> list[str]:
    """The rows of one name of --method: with each of several numbers of gradient steps, and with its checkpoint.

    >>> rows_of("hyperplanes@runs/cars", [0, 10])
    ['hyperplanes@runs/cars', 'hyperplanes_10@runs/cars']

    Args:
        method: the name, with @ and a checkpoint after it or without.
        steps: as in `methods.at_steps`.
    """
    from hyperplanes.methods import at_steps

    name, at, checkpoint = method.partition(AT)
    return [f"{each}{at}{checkpoint}" for each in at_steps(name, steps)]


def run(arguments: Arguments) -> int:
    """Evaluate all methods, print the table and write what was asked for."""
    from hyperplanes.adaptation.checkpoints import find_checkpoints
    from hyperplanes.data.devices import choose_device
    from hyperplanes.evaluation import evaluate_all
    from hyperplanes.evaluation.comparison import compare_all
    from hyperplanes.evaluation.figures import PictureGrid
    from hyperplanes.evaluation.partial_results import PartialResults
    from hyperplanes.evaluation.perceptual import LPIPS
    from hyperplanes.utilities.messages.errors import listed

    _check(arguments)
    console, device = Console(), choose_device(arguments.device)
    checkpoints = [find_checkpoints(with_seed(arguments.checkpoint, seed)) for seed in range(arguments.seeds)]
    data, names = _opened(arguments, device, console)
    lpips = None if arguments.lpips is None else LPIPS(arguments.lpips, device)
    methods = _methods(arguments, checkpoints, data, names, device)
    pictures, failures, kept = PictureGrid(), {}, PartialResults(arguments.json)

    def failed(method: str, seed: int, name: str, error: Exception) -> None:
        failures[name] = f"{method}: {error}"
        bar.warn(f"{name} is left out, {method} failed: {str(error).removeprefix(f'{name}: ')}")

    with console.bar("evaluating") as bar:
        scores = evaluate_all(
            methods,
            data,
            names,
            bar.show,
            seeds=arguments.seeds,
            on_object=pictures.add if arguments.grid is not None else None,
            on_score=kept.add,
            on_failure=failed if len(names) > 1 else None,
            lpips=lpips,
        )
    pairs = compare_all(scores)
    _show(arguments, scores, pairs, console)
    _write(arguments, scores, pairs)
    if arguments.grid is not None:
        pictures.save(arguments.grid)
    kept.remove()
    for option in OUTPUTS:
        if (path := getattr(arguments, option)) is not None:
            console.say(f"written: {path}")
    missing = [name for name in methods if name not in {score.method for score in scores}]
    if missing:
        console.warn(f"methods that failed on every object and are not in the table: {', '.join(missing)}")
    shown = {each.name for each in scores[0].objects}
    if left_out := [name for name in names if name not in shown]:
        console.warn(f"{len(left_out)} of {len(names)} objects are left out: {listed(left_out)}")
    return int(bool(failures))


def _check(arguments: Arguments) -> None:
    """Refuse wrong options before anything is read."""
    from hyperplanes.configuration.presets import preset
    from hyperplanes.utilities.images.plots import figure_kind

    preset(arguments.preset)  # a wrong name is found even if no method needs it
    if not arguments.method:
        raise ValueError("--method: expected at least one, got none")
    if arguments.curve is not None and len(arguments.steps) < 2:
        raise ValueError(f"--curve: expected at least two numbers of --steps to draw, got {len(arguments.steps)}")
    if (fewest := min(arguments.steps, default=0)) < 0:
        raise ValueError(f"--steps: expected 0 or more, got {fewest}")
    for name in arguments.method:
        if name.startswith(AT) or name.endswith(AT):
            raise ValueError(f"--method: expected METHOD{AT}CHECKPOINT, got {name}; add what is missing")
        if not rows_of(name, arguments.steps):
            raise ValueError(f"--steps: expected a number of at least 1 for {name}, got 0")
    for figure in (arguments.curve, arguments.boxes, arguments.grid):
        if figure is not None:
            figure_kind(figure)  # a wrong name is found before anything is evaluated
    for option in OUTPUTS:
        check_output(option, getattr(arguments, option))
    files = [(option, path) for option in OUTPUTS if (path := getattr(arguments, option)) is not None]
    for (one, path), (other, same) in combinations(files, 2):
        if path.resolve() == same.resolve():
            raise ValueError(f"--{one}, --{other}: expected a file each, got {path} twice; rename one")
    for option in ("seeds", "objects", "support", "query"):
        if (number := getattr(arguments, option)) is not None and number < 1:
            raise ValueError(f"--{option}: expected at least 1, got {number}")
    if arguments.inputs and (arguments.support is not None or arguments.choose != "first"):
        given = "--choose" if arguments.support is None else "--support"
        raise ValueError(f"--inputs: expected neither --support nor --choose with it, got {given}; leave one out")
    if arguments.support is None and arguments.choose != "first":
        raise ValueError(f"--choose {arguments.choose}: expected --support as well, got none; add a number of views")


def _opened(arguments: Arguments, device: torch.device, console: Console) -> tuple[list[TasksOnDevice], Sequence[str]]:
    """The data set of each seed, and the names of the objects to evaluate."""
    from hyperplanes.data import open_dataset
    from hyperplanes.data.devices import TasksOnDevice

    opened = open_dataset(arguments.data, legacy=arguments.legacy)
    for line in opened.skipped:
        console.warn(line)
    up = _up(arguments, opened, console)
    data = [TasksOnDevice(_tasks(arguments, opened, seed), device, up) for seed in range(arguments.seeds)]
    names = opened.names(arguments.split)[: arguments.objects]
    if not names:
        raise ValueError(f"{arguments.data}: expected objects in its {arguments.split} split, found none; see --split")
    return data, names


def _methods(
    arguments: Arguments,
    checkpoints: Sequence[Mapping[str, Path]],
    data: Sequence[Tasks],
    names: Sequence[str],
    device: torch.device,
) -> dict[str, Callable[[int], WithSampler]]:
    """By the name of each row, a function that makes its method from a seed."""
    from hyperplanes.adaptation.checkpoints import find_checkpoints
    from hyperplanes.adaptation.fine_tuned import FineTuned
    from hyperplanes.configuration.fine_tuning import FineTuning
    from hyperplanes.configuration.presets import PROTOCOLS
    from hyperplanes.methods import Request, WithSampler, make_method

    chosen = list(dict.fromkeys(row for name in arguments.method for row in rows_of(name, arguments.steps)))
    named = {
        (row, seed): find_checkpoints(with_seed([Path(row.partition(AT)[2])], seed))
        for row in chosen
        for seed in range(arguments.seeds)
        if AT in row
    }

    def make(row: str, seed: int) -> WithSampler:
        request = Request(
            row.partition(AT)[0],
            named.get((row, seed), checkpoints[seed]),
            device=device,
            settings=FineTuning(trainable=arguments.fine_tune, seed=seed),
            objects=_supports(data[seed], names),
            preset=arguments.preset,
            protocol=arguments.protocol,
        )
        return WithSampler(make_method(request), PROTOCOLS[arguments.protocol])

    first = {name: make(name, 0) for name in chosen}  # a wrong name is found before the first object is adapted to
    check_fine_tune(arguments.fine_tune, sum(isinstance(made.adapter, FineTuned) for made in first.values()))
    return {name: lambda seed, name=name: make(name, seed) if seed else first[name] for name in chosen}


def _show(arguments: Arguments, scores: Sequence[Score], pairs: Sequence[Comparison], console: Console) -> None:
    """Print the tables of methods and of their pairs, and what was compared."""
    from hyperplanes.evaluation.tables import PAIR_HEADINGS, compared_rows, headings, rows

    count = len(scores[0].objects)
    console.table(headings(scores), rows(scores))
    if count > 1 and pairs:
        console.table(PAIR_HEADINGS, compared_rows(pairs[:LARGEST_TABLE]))
        if (more := len(pairs) - LARGEST_TABLE) > 0:
            console.say(f"{counted(more, 'more pair')} with smaller differences: --markdown FILE writes all of them")
    console.say(f"{counted(count, 'object')} of {arguments.data}{_of_seeds(arguments)}")
    if line := _of_shown(scores):
        console.warn(line)


def _tasks(arguments: Arguments, opened: Dataset, seed: int) -> Tasks:
    """The objects with the requested support and query views."""
    from hyperplanes.data.support import FewerQueries, SupportByPosition, WithSupport
    from hyperplanes.utilities.messages.errors import rename_errors

    tasks: Tasks = opened
    if arguments.inputs:
        with rename_errors("inputs", "--inputs"):
            tasks = SupportByPosition(opened, arguments.inputs)
    elif arguments.support is not None:
        tasks = WithSupport(opened, arguments.support, arguments.choose, seed)
    return tasks if arguments.query is None else FewerQueries(tasks, arguments.query)


def _supports(data: Tasks, names: Sequence[str]) -> Iterator[Views]:
    """The support views of the objects that can be read; the others are named when they are evaluated."""
    for name in names:
        with suppress(ValueError, OSError):
            yield data.task(name).support


def _up(arguments: Arguments, data: Dataset, console: Console) -> str | None:
    """The direction that is up in the world of the data; None where each object's files say it, or it is y."""
    from hyperplanes.commands.inputs.scene import say_up
    from hyperplanes.data.upright import y_up_from

    if arguments.up == "auto":
        names = data.names() if data.layout == "posed" else []
        if len(names) != 1:
            return None
        scene = data.posed(names[0])
        return say_up([scene.support, scene.query], console)
    y_up_from(arguments.up)  # a wrong one is found before anything is evaluated
    return arguments.up


def _of_seeds(arguments: Arguments) -> str:
    """The meaning of ± in the table; empty for one seed."""
    if arguments.seeds == 1:
        return ""
    named = [*map(str, arguments.checkpoint), *arguments.method]
    varied = ["trainings", "gradient steps"] if any(SEED in each for each in named) else ["gradient steps"]
    varied += ["random weights", *(["choices of support views"] if arguments.choose == "random" else [])]
    return f"; ± is the standard deviation over {arguments.seeds} seeds (of {', '.join(varied)})"


def _of_shown(scores: Sequence[Score]) -> str:
    """A sentence where methods are judged by views that they were shown, otherwise nothing."""
    shown = [int(each.query_views_shown) for each in scores[0].objects if each.query_views_shown]
    if not shown:
        return ""
    return (
        f"{len(shown)} of {counted(len(scores[0].objects), 'object')} compared on query views that the methods were "
        f"given, up to {counted(max(shown), 'view')}: this is not the quality of new views"
    )


def _write(arguments: Arguments, scores: Sequence[Score], pairs: Sequence[Comparison]) -> None:
    """Every file but the grid of pictures."""
    from hyperplanes.evaluation import figures, tables
    from hyperplanes.utilities.files.writing import write_json, write_whole

    if arguments.json is not None:
        write_json(arguments.json, tables.as_json(scores, pairs))
    if arguments.csv is not None:
        write_whole(arguments.csv, tables.as_csv(scores).encode())
    if arguments.markdown is not None:
        about = f"{counted(len(scores[0].objects), 'object')} of {arguments.data}{_of_seeds(arguments)}."
        if line := _of_shown(scores):
            about += f" Caution: {line}."
        write_whole(arguments.markdown, tables.as_markdown(scores, pairs, about).encode())
    if arguments.curve is not None:
        # a method that takes no steps is a level
        quality = {score.method: score.mean("psnr") for score in scores}
        curves = {
            method: [
                (float(count), quality[name])
                for count in arguments.steps
                for name in rows_of(method, [count])
                if name in quality  # it failed on every object
            ]
            for method in arguments.method
        }
        figures.save_curves({name: curve for name, curve in curves.items() if curve}, arguments.steps, arguments.curve)
    if arguments.boxes is not None:
        figures.save_boxes(scores, arguments.boxes)
