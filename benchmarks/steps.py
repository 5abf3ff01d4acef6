"""Measure training steps of the preset `small` on a data set, and the parts of their time.

    python -m benchmarks steps --data data/cars --json FILE

Steps are taken alternately by default, in single precision, and by the reference. The reference uses single precision,
computes gradients for every sample in the hull, and convolves with PyTorch's modules. All start from the packaged
weights and use the same episodes. Also measured is the time to prepare an episode whose images are in memory.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.nn.functional import conv3d

from benchmarks.parts.objects import held_out
from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from benchmarks.parts.timing import interleaved, ratio, timed
from benchmarks.training import Objects, step_parts
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.presets import preset
from hyperplanes.data import open_dataset
from hyperplanes.hypernetwork.volume import volume_network
from hyperplanes.rendering.renderer import RayMarching
from hyperplanes.training import Trainer
from hyperplanes.views import Tasks

__all__ = ["main"]

RATE = 1e-6  # so small that the weights, and with them the work of a step, do not change


def main(arguments: list[str]) -> int:
    """Measure, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks steps", description=__doc__)
    parser.add_argument("--data", type=Path, help="a data set (default: procedural cars)")
    parser.add_argument("--untrained", action="store_true", help="start from initial weights, not the packaged ones")
    parser.add_argument("--repeats", type=positive, default=12, help="steps of each kind (default: %(default)s)")
    parser.add_argument("--threads", type=positive, default=1, help="number of threads (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="small images, one step of each kind")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    before = torch.get_num_threads()
    torch.set_num_threads(chosen.threads)
    try:
        return finish("steps", _measured(chosen), chosen.json)
    finally:
        torch.set_num_threads(before)


def _measured(chosen: argparse.Namespace) -> list[Row]:
    """Rows for the steps of each kind, for their parts, and for preparing an episode."""
    size, views, repeats = (64, 8, 1) if chosen.quick else (128, 50, chosen.repeats)
    data: Tasks = Objects(held_out(4, size, views)) if chosen.data is None else open_dataset(chosen.data)
    ways = {
        "ours": (RayMarching().stop, "automatic"),
        "single": (RayMarching().stop, "single"),
        "reference": (0.0, "single"),
    }
    trainers = {name: _trainer(data, stop, way, chosen.untrained) for name, (stop, way) in ways.items()}
    ours = trainers["ours"]
    for other in (trainers["single"], trainers["reference"]):
        other.loader.get = ours.loader.get  # type: ignore[method-assign]
    names = [name for step in range(repeats + 2) for name in ours.loader.names_of(step)]
    for name in names:
        ours.loader.get(name)
    again = [timed(lambda name=name: ours.loader._load(name))[0] for name in names[: max(1, repeats)]]
    rows = _compare(trainers, repeats)
    rows.append({"name": "an episode, its pictures in memory", "seconds": statistics.median(again)})
    return rows


def _trainer(data: Tasks, stop: float, precision: str, untrained: bool) -> Trainer:
    """A trainer whose weights hardly change; with `stop` 0, every sample has a gradient."""
    settings = preset("small")
    model = HyperPlanes(settings.model) if untrained else HyperPlanes.from_pretrained("small")
    model.config = replace(model.config, sampling=replace(settings.model.sampling, stop=stop))
    rates = {f"{name}learning_rate": RATE for name in ("", "muon_", "hypernetwork_")}
    return Trainer(model, data, replace(settings.training, prefetch=0, precision=precision, **rates))


def _compare(trainers: dict[str, Trainer], repeats: int) -> list[Row]:
    """Rows for the seconds of a step of each trainer, measured alternately, and of the parts of a step."""
    ours, single, reference = trainers.values()

    def plain_step() -> None:
        with _plainly():
            reference.take_step()

    ways = {"ours": ours.take_step, "single": single.take_step, "reference": plain_step}
    times = interleaved(ways, repeats, seconds=180)
    config = ours.config
    row: Row = {"name": f"step of small, {config.tasks} x {config.rays} rays", "threads": torch.get_num_threads()}
    row["seconds"] = statistics.median(times["ours"].wall)
    row["single_precision_seconds"] = statistics.median(times["single"].wall)
    row["reference_seconds"] = statistics.median(times["reference"].wall)
    row |= ratio(times["reference"].wall, times["ours"].wall)
    rows = [row, *step_parts("ours", ours)]
    with _plainly():
        return [*rows, *step_parts("reference", reference)]


@contextmanager
def _plainly() -> Generator[None]:
    """While active, the U-Net convolves with PyTorch's modules alone."""

    def pointwise(layer: nn.Conv3d, *inputs: Tensor) -> Tensor:
        return conv3d(torch.cat(inputs, 1), layer.weight, layer.bias)

    with (
        patch.object(volume_network._Convolution, "forward", nn.Conv3d.forward),
        patch.object(volume_network._Pointwise, "forward", pointwise),
    ):
        yield
