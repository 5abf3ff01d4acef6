"""The two processes of `test_distributed.py`: `python -m tests.training.two_processes FOLDER`.

The module runs `hyperplanes train --devices 2`. Where the command would begin to train, its processes have joined, and
other trainings run first. At the end the second process is killed.
"""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import torch

import hyperplanes.data.dataset
import hyperplanes.training
from hyperplanes import cli
from hyperplanes.adaptation import InitialisationConfig
from hyperplanes.commands.output.console import Console
from hyperplanes.commands.train import follow
from hyperplanes.hypernetwork import ImageHyperNetworkConfig
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.training.initialisation import initialisation_trainer
from hyperplanes.utilities.files.checkpoints import save_tensors
from hyperplanes.utilities.files.writing import write_json
from tests.reference_rendering import Balls, awaken, small_model

CONFIG = TrainingConfig(
    steps=4, tasks=4, rays=16, evaluate_every=100, checkpoint_every=2, learning_rate=1e-3, held_out=0, memory=1
)
SHAPE = {"views": 2, "code": 8, "depth": 2, "width": 16}


class Precise(Balls):
    """Objects in float64."""

    def task(self, name):
        task = super().task(name)
        return replace(task, support=task.support.to("cpu", torch.float64), query=task.query.to("cpu", torch.float64))


class Data(Balls):
    """Objects that the command line accepts as a data set."""

    skipped = ()


def conditioned(folder=None):
    """A training with standardised codes and outputs, reference objects and Muon."""
    model = awaken(small_model(hypernetwork=ImageHyperNetworkConfig(**SHAPE, normalisation="group"))).double()
    return Trainer(model, Precise(6), replace(CONFIG, reference_objects=2, optimiser="muon", steps=3), folder)


def normalised(folder=None):
    """A training with batch normalisation and clipped gradients."""
    model = awaken(small_model(hypernetwork=ImageHyperNetworkConfig(**SHAPE, normalisation="batch"))).double()
    config = replace(CONFIG, tasks=2, clip=0.02)
    return Trainer(model, Precise(3), config, folder)


def initialised(folder=None):
    """A training with Reptile, whose gradient does not come from a backward pass."""
    start = InitialisationConfig("mv_meta", inner_steps=2)
    model = small_model(hypernetwork=None, target="nerf", initialisation=start).double()
    return initialisation_trainer(model, Precise(3), replace(CONFIG, tasks=2, steps=2), folder)


KINDS = {"conditioned": conditioned, "normalised": normalised, "initialised": initialised}

OPTIONS = """
    --model.network.depth 2 --model.network.width 24 --model.network.planes 4 --model.network.point-frequencies 3
    --model.hypernetwork.views 2 --model.hypernetwork.code 8 --model.hypernetwork.width 16 --model.hypernetwork.depth 2
    --model.sampling.steps 24 --model.hull-resolution 16 --training.tasks 2 --training.rays 16 --training.warmup 0
    --training.evaluate-every 2 --training.checkpoint-every 2 --training.held-out 1 --training.precision single
""".split()


class Poisoned(Balls):
    """Objects whose query views have colours that are NaN. The second process trains on them."""

    def task(self, name):
        task = super().task(name)
        query = replace(task.query, images=task.query.images.clone())
        query.images.fill_(float("nan"))  # after the checks of Views
        return replace(task, query=query)


def weights_of(trainer):
    """Copies of the weights."""
    return {name: value.clone() for name, value in trainer.model.state_dict().items()}


def end_of(call):
    """The error that a call raises, as text."""
    try:
        call()
    except (ValueError, KeyboardInterrupt) as error:
        return f"{type(error).__name__}: {error}"
    return "none"


def run_all(folder, rank):
    """Run every training of this module, and save one file of results per process in the folder."""
    told = {}
    for name, kind in KINDS.items():
        trainer = kind(folder / name)  # one of them has a checkpoint of a single process
        list(trainer.run())
        save_tensors(folder / f"{name}-{rank}.safetensors", weights_of(trainer))
        told[name] = trainer.curve[-1]

    data = (Balls, Poisoned)[rank](2, 0)
    told["poisoned"] = end_of(Trainer(small_model(), data, replace(CONFIG, tasks=2)).take_step)
    told["shares"] = end_of(lambda: Trainer(small_model(), Balls(), replace(CONFIG, tasks=3)))

    class Signalled(Trainer):
        def take_step(self):
            if self.step == 1 and rank == 1:
                signal.raise_signal(signal.SIGTERM)
            return super().take_step()

    stopped = Signalled(small_model(), Balls(2, 0), replace(CONFIG, tasks=2), folder / "stopped")
    with Console(silent=True).bar("training") as bar:
        told["stopped"] = end_of(lambda: follow(stopped, bar))
    write_json(folder / f"told-{rank}.json", told | {"step": stopped.step})


def main():
    folder, rank = Path(sys.argv[1]), int(os.environ.get("LOCAL_RANK", "0"))
    start = hyperplanes.training.start_training

    def start_later(*given):
        run_all(folder, rank)
        trainer = start(*given)
        step = trainer.take_step

        def killed_in_step_four():
            if trainer.step == 3:
                os.kill(os.getpid(), signal.SIGKILL)
            return step()

        if rank == 1:
            trainer.take_step = killed_in_step_four
        return trainer

    hyperplanes.training.start_training = start_later
    hyperplanes.data.dataset.open_datasets = lambda *given, **options: Data(3)
    given = f"train --data {folder} --out {folder / 'killed'} --devices 2 --steps 6".split()
    return cli.main([*given, *OPTIONS])


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
