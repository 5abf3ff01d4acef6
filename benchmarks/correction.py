"""Train the correction network of a model, which computes the residual correction of its pictures.

    python -m benchmarks correction --data data/cars data/random --objects 60 --out FOLDER

Each held-out object gives one example of a random number of views: every third one after 100 gradient steps, the others
after one forward pass, and every fifth one with small errors of its camera poses and colours. The objects must be
neither in the training data of the model nor in any table of results. If the model has a correction network, the
training continues from that. The result is a copy of the model with the correction network. `python -m benchmarks views
--methods uncorrected residuals_alone` measures its effect.
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
from hyperplanes.training.correction import (
    CORRECTION_STEPS,
    CorrectionExample,
    disturbed,
    example_of,
    fit_correction,
    recoloured,
)

__all__ = ["main"]

COUNTS = (3, 4, 5, 8, 12, 18, 25, 25)  # numbers of support views; more pictures are from many
QUERY = 6
MAX_DISTURBANCE = 1.0  # degrees
MAX_EXPOSURE = 0.12  # standard deviation of the logarithm of exposures
GRADIENT_STEPS = 100
EVERY_TUNED, EVERY_DISTURBED = 3, 5  # one of as many examples


def main(arguments: list[str]) -> int:
    """Train the correction network, and write the model."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks correction", description=__doc__)
    add_data_options(parser)
    parser.add_argument("--objects", type=positive, default=60, help="held-out objects per data set")
    parser.add_argument("--steps", type=positive, default=CORRECTION_STEPS, help="training steps of the network")
    parser.add_argument("--out", type=Path, metavar="FOLDER", required=True, help="folder to write the model to")
    parser.add_argument("--quick", action="store_true", help="one object and step, to check that it runs")
    chosen = parser.parse_args(arguments)
    model = HyperPlanes.from_pretrained(find_checkpoint(Path(chosen.checkpoint)))
    draws, generator, examples = random.Random(0), torch.Generator().manual_seed(0), list[CorrectionExample]()
    for _, path in suite_folders(parser, chosen):
        data = open_dataset(path)
        for number, name in enumerate(sorted(data.names("test"))[: 1 if chosen.quick else chosen.objects]):
            task = FarthestSupport(data, draws.choice(COUNTS), QUERY).task(name)
            if number % EVERY_DISTURBED == EVERY_DISTURBED - 1:
                support = disturbed(task.support, draws.uniform(0, MAX_DISTURBANCE), generator)
                support = recoloured(support, draws.uniform(0, MAX_EXPOSURE), generator)
                task = replace(task, support=support)
            found = example_of(model, task, GRADIENT_STEPS if number % EVERY_TUNED == EVERY_TUNED - 1 else 0)
            examples += [found] if found is not None else []
        print(f"{path}: {len(examples)} examples", flush=True)

    def report(step: int, gain: float) -> None:
        if step % 100 == 0:
            print(f"step {step} of {chosen.steps}: {gain:+.2f} dB", flush=True)

    network = fit_correction(examples, steps=1 if chosen.quick else chosen.steps, start=model.corrector, on_step=report)
    result = HyperPlanes(replace(model.config, residuals=True, learned_correction=True))
    result.load_state_dict(
        {**model.state_dict(), **{f"corrector.{name}": value for name, value in network.state_dict().items()}}
    )
    result.save(chosen.out, torch.float16)
    print(f"{chosen.out}: the model, with a correction network trained on {len(examples)} examples")
    return 0
