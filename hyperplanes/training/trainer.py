"""Meta-training of theta and the hypernetwork by separate optimiser steps on query rays (HyperPlanes, Algorithm 1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch.profiler import record_function

from hyperplanes.adaptation.diagnostics import Diagnostics
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.compatibility import check_training
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.checkpointing import Checkpointing, choose_precision
from hyperplanes.training.episodes import EpisodeLoader
from hyperplanes.training.episodes.loader import reference_objects, training_names
from hyperplanes.training.monitoring import Progress, Samples, Speed, gradient_norms, write_curve
from hyperplanes.training.objective import Objective, RenderingObjective
from hyperplanes.training.optimisation import Optimisation
from hyperplanes.training.parallel.distributed import ProcessEnded, Processes, check_shares, other_processes
from hyperplanes.training.validation import Validation, Validator
from hyperplanes.utilities.files.encoding import encode_png
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.messages.errors import prefix_errors
from hyperplanes.views import Tasks

__all__ = ["Trainer", "train"]

REPORT_EVERY = 25
"""Steps between reports; there is also a report after every validation."""


class Trainer:
    """The loop of one training.

    The objects of a step are drawn with a generator seeded by (seed, step), and the rays of each object with one seeded
    by (seed, step, place in the step). So a training that is stopped and resumed gives the same weights as an
    uninterrupted one. It computes on the device of the model.

    If several processes share a training (`launching.launched`), each renders its share of the objects of a step. Only
    the first process writes files and validates on held-out objects.

    Args:
        model: the model, which is trained in place.
        data: tasks with a "train" split and optionally a "val" or "test" split.
        config: the configuration of the training.
        folder: the folder for checkpoints; a training in it is resumed.
        objective: computes the gradients of a step; by default those of the losses of rendered rays.

    Raises:
        ValueError: no object to train on, or objects that the processes cannot share evenly.
    """

    @checked
    def __init__(
        self,
        model: HyperPlanes,
        data: Tasks,
        config: TrainingConfig,
        folder: Path | None = None,
        objective: Objective | None = None,
    ) -> None:
        self.model, self.processes = model, Processes.current()
        self.diagnostics: Diagnostics | None = None
        self.samples: Samples | None = None
        self.stopping = False  # set it to end `run` after the current step
        self._stopped = False  # what the processes agreed on in the last step
        names = training_names(data)
        check_training(config, model.config)
        precision = choose_precision(config, model, folder)
        self.config = config = replace(config, steps=config.steps_for(len(names)), precision=precision)
        check_shares(config.tasks, reference_objects(model.config, config), self.processes.count)
        self.folder = folder if self.processes.first else None
        self.optimisation = Optimisation(model, config)
        self.checkpointing = Checkpointing(folder, model, self.optimisation, config, self.processes.first)
        if not (self.checkpointing.resumable or model.rig.any()) and self.processes.first:  # `agree` copies it below
            with prefix_errors(names[0]):
                model.set_rig(data.task(names[0]).support)
        self.objective: Objective = objective or RenderingObjective(model, config)
        self.data = self.objective.tasks(data)
        self.loader = EpisodeLoader(model, self.data, config, self.processes)
        self.validator = Validator(model, self.data, config, self.objective.adapt)
        self.curve: list[dict[str, float]]
        self.step, self.curve = self.checkpointing.resume(self.loader)
        with other_processes():
            self.processes.agree(model, self.step)

    def run(self) -> Iterator[Progress]:
        """Train until the last step, with a report every 25 steps and checkpoints at intervals and at the end.

        It also writes curve.csv, samples/STEP.png with held-out views beside the truth, and best/, the model with the
        highest PSNR of all validations. If `stopping` is set in any process, training ends after the current step with
        a checkpoint.

        Yields:
            The progress at each report.
        """
        try:
            with other_processes():
                yield from self._run()
        finally:
            self.loader.close()

    def _run(self) -> Iterator[Progress]:
        if self.processes.first and self.step < self.config.steps:
            self.validator.prepare()  # an invalid held-out object ends the training before any step is taken
        config, speed = self.config, Speed(self.step, self.config.steps, self.objective.rays_per_step)
        while self.step < config.steps:
            # a thread prepares the next objects during this step
            self.loader.expect(self.step)
            loss = self.take_step()
            # what to do after this step
            step, last = self.step, self.step == config.steps
            validating = step % config.evaluate_every == 0 or last
            reporting = validating or step % REPORT_EVERY == 0
            stopping = self._stopped if self.processes.count > 1 else self.stopping
            saving = step % config.checkpoint_every == 0 or last or stopping
            # validate on held-out objects, in the first process alone
            rays_per_second = speed.rays_per_second(step)
            found = self.validate() if validating and self.processes.first else None
            if found is not None and found.psnr > self._best:
                self.checkpointing.save_best()
            # write the curve, the pictures and the checkpoint
            if reporting:
                self.curve.append(self._row(loss, found))
            if self.folder is not None and (validating or saving):
                self._write(self.folder, found)
            if saving:
                self.save()
            if reporting:
                left = speed.seconds_left(step)
                seen = (None, None) if found is None else (found.psnr, found.diagnostics)
                yield Progress(step, config.steps, loss, rays_per_second, seen[0], left, seen[1])
            if stopping:
                return

    def take_step(self) -> float:
        """Take one training step on newly drawn objects and rays; returns the loss."""
        self.model.train()
        self.optimisation.zero_grad()
        # draw this process's objects of the step
        with record_function("step:data"):
            batch = self.loader.batch(self.step)
        # forward pass, losses and backward pass
        loss = self.objective.gradients(batch)
        # average gradients and losses over the processes, and find out whether any is to stop
        with record_function("step:exchange"):
            loss, self._stopped = self.processes.average(self.optimisation.parameters, loss, self.stopping)
        self.stopping = self.stopping or self._stopped
        if not math.isfinite(loss):
            raise (ValueError if self.processes.first else ProcessEnded)(
                f"step {self.step + 1}, on {', '.join(batch.names)}: expected a finite loss, got {loss}; the last "
                "checkpoint is kept; check the images of these objects, or train with lower rates"
            )
        # update theta and the hypernetwork
        with record_function("step:optimisers"):
            self.optimisation.step(self.step)
        self.step += 1
        return loss

    def validate(self) -> Validation | None:
        """Render query views of held-out objects and compare them; None without such objects."""
        found = self.validator.run()
        if found is not None:
            self.samples, self.diagnostics = found.samples, found.diagnostics or self.diagnostics
        return found

    def save(self) -> None:
        """Write the model and the state of the training to the folder, if there is one."""
        self.checkpointing.save(self.step, self.curve, self.diagnostics, self.loader)

    @torch.no_grad()
    def norms(self) -> dict[str, float]:
        """Norms in the last step: of the gradients of each part, after clipping, and of the updates (root mean square).

        If several processes share the training, all of them must call this method.
        """
        found, updates = gradient_norms(self.model), self.objective.updates
        if self.model.hypernetwork is not None and updates:
            squares = [value.square().sum() for update in updates for value in update.values()]
            found["update"] = float(self.processes.mean(torch.stack(squares).sum() / len(updates)).sqrt())
        return found

    def _row(self, loss: float, found: Validation | None) -> dict[str, float]:
        """A row of the curve."""
        row = {"step": self.step, "loss": loss, **self.norms()}
        if found is not None:
            row["psnr"] = found.psnr
            row |= {} if found.ssim is None else {"ssim": found.ssim}
            row |= found.diagnostics.as_json() if found.diagnostics else {}
        return row

    def _write(self, folder: Path, found: Validation | None) -> None:
        """Write the curve as CSV, and the pictures of a validation."""
        write_curve(folder / "curve.csv", self.curve)
        if found is not None:
            write_whole(folder / "samples" / f"{self.step:08d}.png", encode_png(found.samples.sheet()))

    @property
    def _best(self) -> float:
        """The highest PSNR of the validations so far."""
        return max((row["psnr"] for row in self.curve if row.get("psnr") is not None), default=-math.inf)


def train(
    model: HyperPlanes,
    data: Tasks,
    config: TrainingConfig,
    folder: Path | None = None,
    report: Callable[[Progress], None] | None = None,
) -> Trainer:
    """Run a training to the end. If `folder` has an interrupted training, it is resumed.

    Args:
        model: the model, which is trained in place.
        data: tasks, as in `Trainer`.
        config: the configuration of the training.
        folder: the folder for checkpoints.
        report: called with the progress at each report.

    Returns:
        The finished training.
    """
    trainer = Trainer(model, data, config, folder)
    for progress in trainer.run():
        if report is not None:
            report(progress)
    return trainer
