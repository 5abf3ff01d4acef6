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
        reference: the checkpoint whose weights a new training begins with; for mv_matched that of mv_meta, which it is
            to match.

    Returns:
        A trainer; its `step` says how far it is. CheckpointError where the folder holds another model or training.

    Raises:
        ValueError: a reference with other weights than `config` says.
    """
    matching = config.initialisation is not None and config.initialisation.method == "mv_matched"
    model = HyperPlanes(config, training.seed + matching).to(device)  # not the weights that mv_meta began with
    tasks = TasksOnDevice(data, torch.device(device))
    found = None if reference is None else HyperPlanes.from_pretrained(reference)
    if matching:
        return initialisation_trainer(model, tasks, training, folder, found)
    if found is not None:
        differing = _differing_weights(model, found)
        if differing:
            raise ValueError(f"checkpoint: expected weights of the configured model, got others of {differing[0]}")
        model.load_state_dict(found.state_dict())
    if config.initialisation is None:
        return Trainer(model, tasks, training, folder)
    return initialisation_trainer(model, tasks, training, folder)


def _differing_weights(model: HyperPlanes, other: HyperPlanes) -> list[str]:
    """Names of the weights that one of two models lacks, or that are of another shape."""
    mine, others = ({name: value.shape for name, value in each.state_dict().items()} for each in (model, other))
    return sorted(name for name in mine | others if mine.get(name) != others.get(name))
