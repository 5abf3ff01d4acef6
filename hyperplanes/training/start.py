"""Starts or resumes the training of a model or of an initialisation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from hyperplanes.adaptation.checkpoints import checkpoint_folder
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.data.devices import TasksOnDevice
from hyperplanes.training.initialisation import initialisation_trainer
from hyperplanes.training.parallel.distributed import Processes
from hyperplanes.training.trainer import Trainer
from hyperplanes.utilities.files.checkpoints import read_json
from hyperplanes.utilities.files.encoding import sha256
from hyperplanes.utilities.files.writing import write_json
from hyperplanes.views import Tasks

__all__ = ["start_training"]

INITIAL = "initial.json"
"""The file, in the folder of a training, that names the checkpoint whose weights it began with."""

ARCHITECTURE = ("target", "network", "hypernetwork", "autoencoder", "coarse_network")
MAX_NAMED_ENTRIES = 8  # entries of a configuration that a message names


def start_training(
    config: ModelConfig,
    training: TrainingConfig,
    data: Tasks,
    folder: Path,
    device: torch.device | str = "cpu",
    reference: Path | None = None,
) -> Trainer:
    """A new training, or the interrupted training in `folder`.

    Args:
        config: the configuration of the model.
        training: the configuration of the training; its seed also determines the initial weights.
        data: tasks with a "train" split.
        folder: the folder for checkpoints.
        device: the device to train on.
        reference: the checkpoint whose weights a new training begins with, and whose learned steps and gating network
            the model keeps as they are; for mv_matched, the checkpoint of mv_meta that is matched.

    Returns:
        A trainer; its `step` is the number of steps done. CheckpointError if the folder has another model or training.
        ValueError if the reference does not have the weights of `config` or is not the one that the training began
        with, or if there are fewer support views than planes.
    """
    matching = config.initialisation is not None and config.initialisation.method == "mv_matched"
    if reference is not None and not matching:
        config = _with_later_parts(config, reference)
    model = HyperPlanes(config, training.seed + matching).to(device)  # not the weights that mv_meta began with
    tasks = TasksOnDevice(data, torch.device(device))
    if matching:
        found = None if reference is None else HyperPlanes.from_pretrained(reference)
        if reference is not None and not _goes_on(reference, folder):
            _note(reference, folder)
        return initialisation_trainer(model, tasks, training, folder, found)
    if reference is not None:
        _begin_with(model, reference, folder)
    if Processes.current().first and not (model.rig.any() or (folder / "training.json").exists()):
        _check_views(model, tasks)
    if config.initialisation is None:
        return Trainer(model, tasks, training, folder)
    return initialisation_trainer(model, tasks, training, folder)


def _begin_with(model: HyperPlanes, reference: Path, folder: Path) -> None:
    """Set the weights of a new training to those of a checkpoint, and record the checkpoint in its folder.

    A training that is resumed keeps its own weights; the checkpoint is then only compared with the recorded one.

    Raises:
        ValueError: weights of another model, or a training that began with other weights.
    """
    if _goes_on(reference, folder):
        return
    found = HyperPlanes.from_pretrained(reference)
    if _shapes(model) != _shapes(found):
        config, names = found.config, model.config.differences(found.config)
        parts = {name: name.partition(".")[0] for name in names}
        differing = [
            name for name, part in parts.items() if part in ARCHITECTURE and (part == name or part not in names)
        ]
        written = checkpoint_folder(reference) / "config.yaml"
        known = f"--config {written}" if written.exists() else "the --preset or --config that it was trained by"
        raise ValueError(
            f"checkpoint: expected weights of the configured model, {model.config.method} of the field "
            f"{model.config.target}, got {reference}, {config.method} of the field {config.target}, which differs in "
            f"{', '.join(differing[:MAX_NAMED_ENTRIES])}{', ...' * (len(differing) > MAX_NAMED_ENTRIES)}; give {known}"
        )
    model.load_state_dict(found.state_dict())
    _note(reference, folder)


def _with_later_parts(config: ModelConfig, reference: Path) -> ModelConfig:
    """The configuration with the parts of a checkpoint that were trained after it, if its field is the same.

    They were trained after the model, and no preset has them.
    """
    found = HyperPlanes.from_pretrained(reference).config
    if found.target != config.target:
        return config
    return replace(
        config,
        learned_steps=config.learned_steps or found.learned_steps,
        gated=config.gated or found.gated,
        learned_correction=config.learned_correction or (config.residuals and found.learned_correction),
    )


def _goes_on(reference: Path, folder: Path) -> bool:
    """Whether a folder has a training to resume; if so, the reference must be the one that it began with.

    Raises:
        ValueError: another reference.
    """
    if not (folder / "training.json").exists():
        return False
    note, weights = folder / INITIAL, checkpoint_folder(reference) / "model.safetensors"
    known = read_json(note) if note.exists() else {}
    if weights.exists() and known.get("sha256") != sha256(weights.read_bytes()):
        began = known.get("checkpoint", "random weights")
        raise ValueError(f"checkpoint: expected what the training in {folder} began with, {began}, got {reference}")
    return True


def _note(reference: Path, folder: Path) -> None:
    """Record in the folder of a new training the checkpoint that it begins with or is matched to."""
    weights = checkpoint_folder(reference) / "model.safetensors"
    write_json(folder / INITIAL, {"checkpoint": str(reference), "sha256": sha256(weights.read_bytes())})


def _check_views(model: HyperPlanes, tasks: Tasks) -> None:
    """Refuse data whose first object has fewer support views than the model has planes.

    Raises:
        ValueError: fewer views; the message names a value for `train --support`.
    """
    planes, names = len(model.known_rig), sorted(tasks.names("train"))
    if not planes or not names:
        return
    task = tasks.task(names[0])
    if len(task.support) >= planes:
        return
    count = min(planes, len(task.support) + len(task.query))
    read = 0 if model.hypernetwork is None else model.hypernetwork.views
    fewer = f" --model.hypernetwork.views {count}" if read > count else ""
    raise ValueError(
        f"{task.name}: expected a support view for each of {planes} planes, got {len(task.support)}; "
        f"`train --support {count}{fewer}` takes query views too{', and as many planes' * (count < planes)}"
    )


def _shapes(model: HyperPlanes) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in model.state_dict().items()}
