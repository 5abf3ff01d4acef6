"""A training by what is configured: of a model, or of an initialisation."""

from __future__ import annotations

from pathlib import Path

import torch

from hyperplanes.adaptation.configuration import ModelConfig
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.devices import TasksOnDevice
from hyperplanes.training.configuration import TrainingConfig
from hyperplanes.training.meta_training import initialisation_trainer
from hyperplanes.training.trainer import Trainer
from hyperplanes.views import Tasks

__all__ = ["start_training"]


def start_training(
    config: ModelConfig,
    training: TrainingConfig,
    data: Tasks,
    folder: Path,
    device: torch.device | str = "cpu",
    reference: Path | None = None,
) -> Trainer:
    """A new training, or the one that was interrupted in `folder`.

    Args:
        config: of the model.
        training: how it is trained; its seed is that of the first weights, too.
        data: tasks with a "train" split.
        folder: for checkpoints.
        device: where to compute.
        reference: the checkpoint of mv_meta that mv_matched is to match.

    Returns:
        A trainer; its `step` says how far it is. CheckpointError where the folder holds another model or training.
    """
    matching = config.initialisation is not None and config.initialisation.method == "mv_matched"
    model = HyperPlanes(config, training.seed + matching).to(device)  # not the weights that mv_meta began with
    tasks = TasksOnDevice(data, torch.device(device))
    if config.initialisation is None:
        return Trainer(model, tasks, training, folder)
    matched = None if reference is None else HyperPlanes.from_pretrained(reference)
    return initialisation_trainer(model, tasks, training, folder, matched)
