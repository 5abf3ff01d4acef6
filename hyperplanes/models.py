"""Checkpoints and devices: find a model, load it, adapt it, keep what it became."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from hyperplanes.adaptation.base import AdaptedField, Adapter, Renderable
from hyperplanes.adaptation.configuration import checkpoint_folder
from hyperplanes.adaptation.fine_tuning import FineTuning, Steps
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.checkpoints import CheckpointError
from hyperplanes.data.upright import upright_task
from hyperplanes.fields.base import Field
from hyperplanes.rendering.renderer import Sampler
from hyperplanes.training import Tasks
from hyperplanes.views import Task, Views

__all__ = [
    "ByProtocol",
    "OnDevice",
    "adapt",
    "adapted_model",
    "choose_device",
    "find_checkpoints",
    "load_model",
]


def choose_device(name: str) -> torch.device:
    """The device of that name; "auto" is a GPU where there is one.

    Raises:
        ValueError: a device that torch does not have here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device: expected auto, cpu or one that torch has here, got {name!r} ({reason})") from None
    return device


@dataclass(frozen=True)
class OnDevice:
    """Tasks whose views lie on a device, in a world with y up.

    Attributes:
        data: where they come from.
        device: where they go.
        up: the axis that points up in the data's world.
    """

    data: Tasks
    device: torch.device
    up: str = "y"

    def names(self, split: str) -> Sequence[str]:
        """The objects of a split."""
        return self.data.names(split)

    def task(self, name: str) -> Task:
        """One object."""
        task = upright_task(self.data.task(name), self.up)
        return Task(task.support.to(self.device), task.query.to(self.device), task.name)


@dataclass(frozen=True)
class ByProtocol:
    """A method whose fields are rendered by another protocol than the one they were trained by.

    Attributes:
        adapter: the method.
        sampling: the protocol; None leaves all as it is. What is no field is not sampled, and stays as it is.
    """

    adapter: Adapter
    sampling: Sampler | None

    def adapt(self, support: Views) -> Renderable:
        """What the method makes of one object."""
        made = self.adapter.adapt(support)
        if self.sampling is None or not isinstance(made, AdaptedField):
            return made
        return replace(made, sampling=self.sampling)


def find_checkpoints(folders: Sequence[Path]) -> dict[str, Path]:
    """Checkpoints by the method that trained them.

    Args:
        folders: each a checkpoint, a folder of checkpoints such as `runs/demo`, or the name of a packaged model.

    Returns:
        Folders by "hyperplanes", "point_multiplane" and so on; the first of a kind counts.

    Raises:
        CheckpointError: a folder that neither is nor holds a checkpoint.
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
        for path in inside:
            config = ModelConfig.load(path)
            found.setdefault("hyperplanes" if config.hypernetwork else config.target, path)
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


def adapt(
    model: HyperPlanes,
    support: Views,
    steps: Steps = 0,
    settings: FineTuning | None = None,
    on_step: Callable[[int], None] | None = None,
) -> AdaptedField:
    """The field of an object in one step, or after fine-tuning; as `HyperPlanes.adapt` and `HyperPlanes.fine_tune`."""
    return model.fine_tune(support, steps, settings, on_step=on_step) if steps else model.adapt(support)


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
    result = HyperPlanes(replace(model.config, hypernetwork=None))
    result.rig.copy_(model.rig)
    for name, field in (("fine", adapted.field), ("coarse", adapted.proposal)):
        if name not in result.networks:
            continue
        if not isinstance(field, Field):
            raise ValueError(f"adapted: expected a field that {type(model).__name__} made, got {type(field).__name__}")
        result.networks[name].load_state_dict(field.parameters)
    return result.eval()
