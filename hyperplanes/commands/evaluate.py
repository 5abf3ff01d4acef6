"""Compare methods on objects that none of them was trained on: mean PSNR and SSIM over the query views, as one table.

Every method goes through the same code: it is shown the support views of an object and judged by the others. The data
set may be one that `generate` wrote or a single posed scene, such as a folder with transforms.json.

Example:
    hyperplanes evaluate --data data/cars --checkpoint runs/cars --method nearest_view hyperplanes hyperplanes_10
    hyperplanes evaluate --data photos/ --checkpoint runs/demo --method hyperplanes --json photos.json
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from hyperplanes.commands.console import Console
from hyperplanes.commands.options import OptionalInt, Protocol, Up, optional
from hyperplanes.words import duration

if TYPE_CHECKING:
    from hyperplanes.evaluation import Score

__all__ = ["HEADINGS", "Arguments", "rows", "run"]

HEADINGS = ("method", "PSNR", "SSIM", "to adapt", "to render a view")


@dataclass(frozen=True)
class Arguments:
    """What to compare on what.

    Attributes:
        data: A data set or one posed scene.
        method: nearest_view, point_multiplane, hyperplanes, hyperplanes_10 (after 10 fine-tuning steps) and so on.
        checkpoint: Folders that `train` wrote, or folders of them such as runs/demo.
        json: Write the table here too, with every object.
        split: Which objects.
        objects: Only the first so many.
        up: The axis that points up in the data's world: y as in training data, z as in Blender.
        protocol: How fields are sampled: as they were trained, or 64 + 128 times a ray as in the paper.
        device: auto, cpu or cuda.
    """

    data: Path
    method: tuple[str, ...] = ("nearest_view", "hyperplanes")
    checkpoint: tuple[Path, ...] = ()
    json: Annotated[Path | None, optional("FILE")] = None
    split: Literal["test", "val", "train", "all"] = "test"
    objects: OptionalInt = None
    up: Up = "y"
    protocol: Protocol = "default"
    device: str = "auto"


def rows(scores: Sequence[Score]) -> list[tuple[str, ...]]:
    """The table as text, one row a method."""
    return [
        (
            score.method,
            f"{score.mean('psnr'):.2f} dB",
            f"{score.mean('ssim'):.3f}",
            duration(score.mean("adapt_seconds")),
            duration(score.mean("render_seconds")),
        )
        for score in scores
    ]


def run(arguments: Arguments) -> int:
    """Evaluate all methods and print the table."""
    from hyperplanes.data import open_dataset
    from hyperplanes.evaluation import make_method
    from hyperplanes.files import write_json
    from hyperplanes.models import ByProtocol, OnDevice, choose_device, find_checkpoints, on_device
    from hyperplanes.presets import PROTOCOLS
    from hyperplanes.recipes import score_all

    console, device = Console(), choose_device(arguments.device)
    checkpoints = find_checkpoints(arguments.checkpoint)
    data = open_dataset(arguments.data)
    names = data.names(arguments.split)[: arguments.objects]
    if not names:
        raise ValueError(f"{arguments.data}: expected objects in its {arguments.split} split, found none; see --split")
    sampling = PROTOCOLS[arguments.protocol]
    methods = {
        name: ByProtocol(on_device(make_method(name, checkpoints), device), sampling) for name in arguments.method
    }
    with console.bar("evaluating") as bar:
        scores = score_all(methods, OnDevice(data, device, arguments.up), names, bar.show)
    if arguments.json is not None:
        write_json(arguments.json, {score.method: score.as_json() for score in scores})
    console.table(HEADINGS, rows(scores))
    console.say(f"{len(names)} objects of {arguments.data}")
    return 0
