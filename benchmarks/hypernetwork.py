"""Ablations of the hypernetwork: variants are trained in the same way and evaluated on held-out objects.

Every variant trains the preset "quick" with the same objects, rays and steps, and changes what its name says. Its PSNR
on held-out objects is compared with that of the same field without a hypernetwork, and with the update of another
object. The data sets are made first, for example:

    hyperplanes generate --class car --count 210 --held-out 10 --resolution 64 --seed 0 --out data/car
    python -m benchmarks hypernetwork --data data/car --planes 5 --variant none low_rank --json table.json
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.parts.options import positive
from benchmarks.parts.reporting import Row, finish
from hyperplanes.adaptation.diagnostics import diagnose
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.presets import Preset, preset
from hyperplanes.data.dataset import open_datasets
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.training import Trainer
from hyperplanes.training.episodes import prepare_episode
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Tasks

__all__ = ["VARIANTS", "main", "measure", "variant"]

NONE: dict[str, Any] = {"none": True}
PAPER_UPDATE = {"layers": ("colour", "density"), "update": "full", "activation": "relu", "weights_seen": "updated"}
UNSTANDARDISED = {"code_normalisation": "none", "centre": False}

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "none": ("no hypernetwork", NONE),
    "low_rank": ("the preset: low-rank update of every layer, codes and outputs standardised over objects", {}),
    "uncentred": ("outputs not standardised: the update may have a part that all objects share", {"centre": False}),
    "mean": ("codes of the views averaged, not concatenated", {"join": "mean"}),
    "relu": ("ReLU, not SiLU, in the head", {"activation": "relu"}),
    "blind": ("theta is no input", {"see_weights": False}),
    "undirected": ("viewing directions are no input", {"see_directions": False}),
    "last_layers": ("full update of the colour and density layers, as in the paper; codes, outputs standardised",
                    PAPER_UPDATE),
    "published": ("the same with nothing standardised", {**PAPER_UPDATE, **UNSTANDARDISED}),
    "last_layers_low_rank": ("low-rank update of colour and density layers only", {"layers": ("colour", "density")}),
    "no_warmup": ("full rates from the first step", {}),
    "paper_rates": ("1e-4 for theta and the hypernetwork by Adam, no warm-up, no schedule", {}),
}  # fmt: skip
"""For each variant, what it changes, and the fields of ImageHyperNetworkConfig that differ from the preset."""

PAPER_RATES = {"learning_rate": 1e-4, "hypernetwork_learning_rate": 1e-4, "warmup": 0, "final_rate_factor": 1.0}
TRAINING: dict[str, dict[str, Any]] = {"no_warmup": {"warmup": 0}, "paper_rates": {"optimiser": "adam", **PAPER_RATES}}
"""The fields of TrainingConfig that a variant changes."""


def main(arguments: list[str]) -> int:
    """Train the variants, print the rows, and write them to --json if given."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks hypernetwork", description=__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets, one per class")
    parser.add_argument("--variant", nargs="+", choices=VARIANTS, default=["none", "low_rank"])
    parser.add_argument("--planes", type=positive, default=25, help="number of ImagePlanes of the field")
    parser.add_argument("--optimiser", choices=("adam", "muon"), default="muon", help="optimiser of theta")
    parser.add_argument("--tasks", type=positive, default=4, help="objects per step; they share 768 rays")
    parser.add_argument("--references", type=int, default=0, help="more objects per step, which are not rendered")
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--quick", action="store_true", help="20 steps, to check that it runs")
    parser.add_argument("--out", type=Path, help="folder for checkpoints, from which interrupted trainings continue")
    parser.add_argument("--json", type=Path, metavar="FILE", help="JSON file to write the rows to")
    chosen = parser.parse_args(arguments)
    data = open_datasets(chosen.data)
    steps = 20 if chosen.quick else chosen.steps
    rows = []
    for name in chosen.variant:
        for seed in chosen.seeds:
            made = variant(name, planes=chosen.planes, optimiser=chosen.optimiser, tasks=chosen.tasks, steps=steps)
            made = replace(made, training=replace(made.training, seed=seed, reference_objects=chosen.references))
            folder = chosen.out and chosen.out / f"{name}-{chosen.planes}-{chosen.optimiser}-{seed}"
            classes = len(chosen.data)
            setting = {"planes": chosen.planes, "classes": classes, "tasks": chosen.tasks}
            setting |= {"references": chosen.references, "seed": seed}
            rows.append({"name": name, **setting, **measure(made, data, folder)})
            print(rows[-1], flush=True)
    return finish("hypernetwork", rows, chosen.json)


def variant(name: str, *, planes: int = 25, optimiser: str = "muon", tasks: int = 4, steps: int = 1200) -> Preset:
    """The preset "quick" with a variant of its hypernetwork.

    Args:
        name: one of VARIANTS.
        planes: number of ImagePlanes of the field; the hypernetwork reads as many views, at most 5.
        optimiser: of theta; "adam" or "muon".
        tasks: objects per step.
        steps: training steps.
    """
    made, changes = preset("quick"), VARIANTS[name][1]
    trained = {"optimiser": optimiser, **TRAINING.get(name, {})}
    hyper = made.model.hypernetwork
    assert isinstance(hyper, ImageHyperNetworkConfig)
    hyper = None if changes is NONE else replace(hyper, views=min(hyper.views, planes), **changes)
    return replace(
        made,
        model=replace(made.model, hypernetwork=hyper, network=replace(made.model.network, planes=planes)),
        training=replace(made.training, tasks=tasks, rays=768 // tasks, steps=steps, held_out=0, **trained),
    )


def measure(made: Preset, data: Tasks, folder: Path | None = None, views: int = 4) -> Row:
    """Train a variant, and evaluate it on the held-out objects.

    Args:
        made: the variant.
        data: tasks; with several classes, names begin with the class.
        folder: for checkpoints; None writes none.
        views: number of query views per object.

    Returns:
        PSNR in dB with the update of each object itself and with the update of the next object of its class, spread and
        norm of the updates, and seconds of training.
    """
    model = HyperPlanes(made.model, made.training.seed)
    trainer = Trainer(model, data, made.training, folder)
    begun = time.perf_counter()
    while trainer.step < made.training.steps:
        trainer.take_step()
        if trainer.step % made.training.checkpoint_every == 0:
            trainer.save()
    seconds = time.perf_counter() - begun
    trainer.save()
    return {**judge(model.eval(), data, views), "seconds": seconds}


@torch.no_grad()
def judge(model: HyperPlanes, data: Tasks, views: int) -> Row:
    """Evaluate a trained model; the result is as in `measure`, without the seconds."""
    names = list(data.names("test"))
    episodes = []
    for name in names:
        task = data.task(name)
        few = task.query[:: max(1, len(task.query) // views)][:views]
        episodes.append(prepare_episode(model, replace(task, query=few)))
    updates = model.updates([each.prepared for each in episodes])
    classes = [name.rpartition("/")[0] for name in names]

    def quality(shift: int) -> float:
        total = 0.0
        for index, each in enumerate(episodes):
            same = [i for i, label in enumerate(classes) if label == classes[index]]
            donor = same[(same.index(index) + shift) % len(same)]
            field = model.field(each.prepared, model.theta + updates[donor])
            total += float(psnr(field.render(each.query.cameras).images, each.query.images).mean())
        return total / len(episodes)

    own: Row = {"psnr": quality(0)}
    if model.hypernetwork is None:
        return own
    found = diagnose(model, [each.prepared for each in episodes])
    swapped = quality(1)
    gap = {"swapped": swapped, "swap_gap": float(own["psnr"]) - swapped}
    return {**own, **gap, "spread": found.spread, "norm": found.norm, "active": found.active}
