"""Train the gating network of a model, which weights its pictures and those of `hull_blend`.

    python -m benchmarks gating --data data/cars data/random --objects 24 --out FOLDER

Each held-out object gives two examples, one upright and one in a random orientation, each from a random number of
views. The objects must be neither in the training data of the model nor in any table of results. The result is a copy
of the model with the gating network. `python -m benchmarks views --methods ungated unstacked` measures its effect.
"""

from __future__ import annotations

import argparse
import random
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.parts.options import positive
from benchmarks.views import add_data_options, suite_folders
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.checkpoints import find_checkpoint
from hyperplanes.data import open_dataset
from hyperplanes.data.support import FarthestSupport
from hyperplanes.training.gating import GatingExample, example_of, fit_gate, turned

__all__ = ["main"]

COUNTS = (3, 5, 7, 10, 15, 25, 40)  # numbers of support views
QUERY = 2


def main(arguments: list[str]) -> int:
    """Train the gating network, and write the model."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks gating", description=__doc__)
    add_data_options(parser)
    parser.add_argument("--objects", type=positive, default=24, help="held-out objects per data set")
    parser.add_argument("--out", type=Path, metavar="FOLDER", required=True, help="folder to write the model to")
    parser.add_argument("--quick", action="store_true", help="one object, to check that it runs")
    chosen = parser.parse_args(arguments)
    model = HyperPlanes.from_pretrained(find_checkpoint(Path(chosen.checkpoint)))
    draws, generator, examples = random.Random(0), torch.Generator().manual_seed(0), list[GatingExample]()
    for _, path in suite_folders(parser, chosen):
        data = open_dataset(path)
        for name in sorted(data.names("test"))[: 1 if chosen.quick else chosen.objects]:
            for upright in (True, False):
                task = FarthestSupport(data, draws.choice(COUNTS), QUERY).task(name)
                examples.append(example_of(model, task if upright else turned(task, generator)))
        print(f"{path}: {len(examples)} examples", flush=True)
    result = HyperPlanes(replace(model.config, gated=True))
    gate = {f"gate.{name}": value for name, value in fit_gate(examples).state_dict().items()}
    result.load_state_dict({**model.state_dict(), **gate})
    result.save(chosen.out, torch.float16)
    print(f"{chosen.out}: the model, with a gating network trained on {len(examples)} examples")
    return 0
