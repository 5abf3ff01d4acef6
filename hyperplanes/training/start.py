"""A training by what is configured: of a model, or of an initialisation."""

from __future__ import annotations

from pathlib import Path

import torch

from hyperplanes.adaptation.configuration import ModelConfig, checkpoint_folder
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.checkpoints import read_json
from hyperplanes.devices import TasksOnDevice
from hyperplanes.files import sha256, write_json
from hyperplanes.training.configuration import TrainingConfig
from hyperplanes.training.meta_training import initialisation_trainer
from hyperplanes.training.trainer import Trainer
from hyperplanes.views import Tasks

__all__ = ["start_training"]

INITIAL = "initial.json"
"""In the folder of a training: the checkpoint that it began with."""


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
        A trainer; its `step` says how far it is. CheckpointError where the folder holds another model or training,
        ValueError for a reference with other weights than `config` says, or another than the training began with.
    """
    matching = config.initialisation is not None and config.initialisation.method == "mv_matched"
    model = HyperPlanes(config, training.seed + matching).to(device)  # not the weights that mv_meta began with
    tasks = TasksOnDevice(data, torch.device(device))
    if matching:
        found = None if reference is None else HyperPlanes.from_pretrained(reference)
        return initialisation_trainer(model, tasks, training, folder, found)
    if reference is not None:
        _begin_with(model, reference, folder)
    if config.initialisation is None:
        return Trainer(model, tasks, training, folder)
    return initialisation_trainer(model, tasks, training, folder)


def _begin_with(model: HyperPlanes, reference: Path, folder: Path) -> None:
    """Set the weights of a new training, and note in its folder where they are from.

    A training that goes on has its own weights; the reference is then only compared with that note, if it is there.

    Raises:
        ValueError: weights of another model, or a training that began with others.
    """
    note, weights = folder / INITIAL, checkpoint_folder(reference) / "model.safetensors"
    if (folder / "training.json").exists():
        known = read_json(note) if note.exists() else {}
        if weights.exists() and known.get("sha256") != sha256(weights.read_bytes()):
            began = known.get("checkpoint", "random weights")
            raise ValueError(f"checkpoint: expected what the training in {folder} began with, {began}, got {reference}")
        return
    found = HyperPlanes.from_pretrained(reference)
    differing = _differing_weights(model, found)
    if differing:
        raise ValueError(f"checkpoint: expected weights of the configured model, got others of {differing[0]}")
    model.load_state_dict(found.state_dict())
    write_json(note, {"checkpoint": str(reference), "sha256": sha256(weights.read_bytes())})


def _differing_weights(model: HyperPlanes, other: HyperPlanes) -> list[str]:
    """Names of the weights that one of two models lacks, or that are of another shape."""
    mine, others = ({name: value.shape for name, value in each.state_dict().items()} for each in (model, other))
    return sorted(name for name in mine | others if mine.get(name) != others.get(name))
