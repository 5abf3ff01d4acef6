"""Checkpoints of models: find and load them, and make one of the weights of a single object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.configuration import ModelConfig, checkpoint_folder
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.fields.base import Field
from hyperplanes.utilities.checkpoints import CheckpointError

__all__ = ["adapted_model", "find_checkpoints", "load_model"]


def find_checkpoints(folders: Sequence[Path]) -> dict[str, Path]:
    """Checkpoints by the method that trained them.

    Args:
        folders: each a checkpoint, a folder of checkpoints such as `runs/demo`, or the name of a packaged model.

    Returns:
        Folders by the names of their methods, such as "hyperplanes"; of those in one folder the first of a name counts.

    Raises:
        CheckpointError: a folder that neither is nor holds a checkpoint, or two folders with the same method.
    """
    found: dict[str, Path] = {}
    for folder in map(checkpoint_folder, folders):
        inside = [folder] if (folder / "model.json").exists() else sorted(p.parent for p in folder.glob("*/model.json"))
        if not inside:
            what = "no model.json" if folder.is_dir() else "no such folder"
            raise CheckpointError(
                f"{folder}: expected a checkpoint, found {what}; "
                "`hyperplanes train` writes one, `hyperplanes demo` makes a small one in minutes"
            )
        here: dict[str, Path] = {}
        for path in inside:
            here.setdefault(ModelConfig.load(path).method, path)
        for method, path in here.items():
            other = found.setdefault(method, path)
            if other.resolve() != path.resolve():
                raise CheckpointError(
                    f"checkpoint: expected one of each method, got {other} and {path}, which are both {method}; "
                    "give one of them at a time"
                )
    return found


def load_model(folder: Path) -> HyperPlanes:
    """The model of a checkpoint, or of a folder of checkpoints its HyperPlanes.

    Raises:
        CheckpointError: no checkpoint there, or several without a HyperPlanes among them.
    """
    found = find_checkpoints([folder])
    if "hyperplanes" not in found and len(found) > 1:
        raise CheckpointError(f"{folder}: expected one checkpoint, found {', '.join(sorted(found))}; name one of them")
    return HyperPlanes.from_pretrained(found.get("hyperplanes") or next(iter(found.values())))


@torch.no_grad()
def adapted_model(model: HyperPlanes, adapted: AdaptedField) -> HyperPlanes:
    """The weights of one object as a model without a hypernetwork: its theta is theta + delta (HyperPlanes, Eq. 6).

    Args:
        model: what adapted.
        adapted: its answer.

    Returns:
        A model that makes the same field of the same views, without looking at them twice.

    Raises:
        ValueError: a field that is no network of this model.
    """
    result = HyperPlanes(replace(model.config, hypernetwork=None, autoencoder=None, initialisation=None))
    result.rig.copy_(model.rig)
    for name, field in (("fine", adapted.field), ("coarse", adapted.proposal)):
        if name not in result.networks:
            continue
        if not isinstance(field, Field):
            raise ValueError(f"adapted: expected a field that {type(model).__name__} made, got {type(field).__name__}")
        result.networks[name].load_state_dict(field.parameters)
    return result.eval()
