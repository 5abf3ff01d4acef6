"""Compare methods on objects that none of them was trained on: mean PSNR and SSIM over the query views, as one table.

Every method goes through the same code: it is shown the support views of an object and judged by the others. The data
set may be one that `generate` wrote or a single posed scene, such as a folder with transforms.json.

A method's name may end in a number of fine-tuning steps on the support views of each object, or in _auto. With --steps
every method that can be fine-tuned is evaluated at each of those numbers, and --curve draws its PSNR over them.

Example:
    hyperplanes evaluate --data data/cars --checkpoint runs/cars --method nearest_view hyperplanes hyperplanes_swapped
    hyperplanes evaluate --data data/cars --checkpoint runs/cars --method hyperplanes scratch --steps 10 100
    hyperplanes evaluate --data photos/ --checkpoint runs/demo --method hyperplanes --json photos.json
    hyperplanes evaluate --data photos/ --method nearest_view hull_blend point_multiplane_scratch_300
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import Free, OptionalInt, Protocol, Up, optional
from hyperplanes.formatting import format_duration

if TYPE_CHECKING:
    from hyperplanes.evaluation import Score

__all__ = ["HEADINGS", "Arguments", "rows", "run"]

HEADINGS = ("method", "PSNR", "SSIM", "to adapt", "to render a view")


@dataclass(frozen=True)
class Arguments:
    """What to compare on what.

    Attributes:
        data: A data set or one posed scene.
        method: nearest_view and hull_blend (nothing is learned); nerf, multiplane, point_multiplane, hyperplanes,
            hyperplanes_swapped (each object with the update of another), autoencoder; scratch_N (the field of a
            checkpoint from random weights), nerf_scratch_N, multiplane_scratch_N, point_multiplane_scratch_N (no
            checkpoint is needed); standard, mv_matched, mv_shuffled, mv_meta, sv_meta, maml, maml_first_order. All but
            the first two and hyperplanes_swapped may be followed by _N or _auto for gradient steps.
        checkpoint: Folders that `train` wrote, or folders of them such as runs/demo.
        json: Write the table here too, with every object.
        steps: Evaluate methods after so many fine-tuning steps, each number a row; 0 is the method itself.
        curve: Draw PSNR over --steps into this SVG file.
        fine_tune: What fine-tuning optimises: theta + delta itself, or the hypernetwork with theta frozen.
        split: Which objects.
        objects: Only the first so many.
        support: Support views an object; more than there are go on with the query views.
        preset: The shape of fields that need no checkpoint.
        up: The axis that points up in the data's world: y as in training data, z as in Blender.
        protocol: How fields are sampled: as they were trained, 64 + 128 times a ray as in the paper, or fast.
        legacy: The principal point of learnit's and the paper's own files is at W / 2 at integer pixel centres.
        device: auto, cpu or cuda.
    """

    data: Path
    method: tuple[str, ...] = ("nearest_view", "hyperplanes")
    checkpoint: tuple[Path, ...] = ()
    json: Annotated[Path | None, optional("FILE")] = None
    steps: tuple[int, ...] = ()
    curve: Annotated[Path | None, optional("FILE")] = None
    fine_tune: Free = "weights"
    split: Literal["test", "val", "train", "all"] = "test"
    objects: OptionalInt = None
    support: OptionalInt = None
    preset: str = "quick"
    up: Up = "y"
    protocol: Protocol = "default"
    legacy: bool = False
    device: str = "auto"


def rows(scores: Sequence[Score]) -> list[tuple[str, ...]]:
    """The table as text, one row a method."""
    return [
        (
            score.method,
            f"{score.mean('psnr'):.2f} dB",
            f"{score.mean('ssim'):.3f}",
            format_duration(score.mean("adapt_seconds")),
            format_duration(score.mean("render_seconds")),
        )
        for score in scores
    ]


def run(arguments: Arguments) -> int:
    """Evaluate all methods and print the table."""
    from hyperplanes.adaptation.fine_tuning import FineTuning
    from hyperplanes.adaptation.pretrained import find_checkpoints
    from hyperplanes.data import open_dataset
    from hyperplanes.devices import TasksOnDevice, choose_device
    from hyperplanes.evaluation import evaluate_all
    from hyperplanes.files import write_json
    from hyperplanes.methods import WithSampler, at_steps, make_method
    from hyperplanes.presets import PROTOCOLS
    from hyperplanes.support import WithSupport

    if arguments.curve is not None and len(arguments.steps) < 2:
        raise ValueError(f"--curve: expected at least two numbers of --steps to draw, got {len(arguments.steps)}")
    console, device = Console(), choose_device(arguments.device)
    checkpoints = find_checkpoints(arguments.checkpoint)
    opened = open_dataset(arguments.data, legacy=arguments.legacy)
    for line in opened.skipped:
        console.warn(line)
    tasks = opened if arguments.support is None else WithSupport(opened, arguments.support)
    data = TasksOnDevice(tasks, device, arguments.up)
    names = data.names(arguments.split)[: arguments.objects]
    if not names:
        raise ValueError(f"{arguments.data}: expected objects in its {arguments.split} split, found none; see --split")
    sampling, settings = PROTOCOLS[arguments.protocol], FineTuning(free=arguments.fine_tune)

    def make(name: str) -> WithSampler:
        objects = (data.task(each).support for each in names)
        made = make_method(
            name,
            checkpoints,
            device=device,
            settings=settings,
            objects=objects,
            preset=arguments.preset,
            protocol=arguments.protocol,
        )
        return WithSampler(made, sampling)

    chosen = [each for name in arguments.method for each in at_steps(name, arguments.steps)]
    methods = {name: make(name) for name in dict.fromkeys(chosen)}
    with console.bar("evaluating") as bar:
        scores = evaluate_all(methods, data, names, bar.show)
    if arguments.json is not None:
        write_json(arguments.json, {score.method: score.as_json() for score in scores})
    if arguments.curve is not None:
        _draw(scores, arguments.method, arguments.steps, arguments.curve)
        console.say(f"{arguments.curve}: PSNR over fine-tuning steps")
    console.table(HEADINGS, rows(scores))
    console.say(f"{len(names)} objects of {arguments.data}")
    return 0


def _draw(scores: Sequence[Score], methods: Sequence[str], steps: Sequence[int], path: Path) -> None:
    """PSNR over fine-tuning steps of every method that was evaluated at several."""
    from hyperplanes.demo.charts import line_chart, standalone
    from hyperplanes.files import write_whole
    from hyperplanes.methods import at_steps

    quality = {score.method: score.mean("psnr") for score in scores}
    curves = {}
    for method in methods:
        named = [(count, name) for count in steps for name in at_steps(method, [count])]
        curves[method] = [(float(count), quality[name]) for count, name in named]
    chart = line_chart(curves, "PSNR over fine-tuning steps", "dB", horizontal="fine-tuning steps", dense=True)
    write_whole(path, standalone(chart).encode())
