"""From a preset and a method to a model, its training and the table: what `train`, `evaluate` and `demo` share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from hyperplanes.adaptation.base import Adapter
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.evaluation import ObjectScore, Score, evaluate
from hyperplanes.models import OnDevice
from hyperplanes.presets import Preset, preset
from hyperplanes.training import Tasks, Trainer

__all__ = ["TRAINABLE", "new_model", "recipe", "score_all", "start_training"]

TRAINABLE = ("hyperplanes", "point_multiplane", "multiplane", "nerf")
"""Methods that `train` knows; all but the first are one set of weights for all objects."""


def recipe(
    name: str, method: str = "hyperplanes", *, steps: int | None = None, seed: int = 0, protocol: str = "default"
) -> Preset:
    """The configuration of a method at the scale of a preset.

    Args:
        name: of the preset.
        method: one of TRAINABLE.
        steps: other than the preset's.
        seed: of the training.
        protocol: a name in PROTOCOLS: how rays are sampled.

    Returns:
        Model and training.

    Raises:
        ValueError: an unknown preset, method or protocol, or no step.
    """
    if method not in TRAINABLE:
        raise ValueError(f"method: expected one of {', '.join(TRAINABLE)}, got {method!r}")
    if steps is not None and steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    chosen = preset(name).by_protocol(protocol)
    if method != "hyperplanes":
        chosen = chosen.without_hypernetwork()
    return replace(
        chosen,
        model=chosen.model if method == "hyperplanes" else replace(chosen.model, target=method),
        training=replace(chosen.training, steps=steps or chosen.training.steps, seed=seed),
    )


def new_model(config: ModelConfig, seed: int) -> HyperPlanes:
    """An untrained model; the same seed gives the same weights, and the global random state is left alone."""
    return HyperPlanes(config, seed)


def score_all(
    methods: Mapping[str, Adapter],
    data: Tasks,
    names: Sequence[str],
    report: Callable[[int, int, str], None],
) -> list[Score]:
    """Every method on every object.

    Args:
        methods: by the names of their rows.
        data: where the objects are.
        names: the objects.
        report: called with (evaluations done, evaluations in all, what has just been found) after each.

    Returns:
        The rows in the order of the methods.
    """
    done, scores = 0, []

    def count(method: str, score: ObjectScore) -> None:
        nonlocal done
        done += 1
        report(done, len(methods) * len(names), f"{method} on {score.name}: {score.psnr:.2f} dB")

    for method, adapter in methods.items():
        scores.append(evaluate(method, adapter, data, names, lambda score, *_, method=method: count(method, score)))
    return scores


def start_training(chosen: Preset, data: Tasks, folder: Path, device: torch.device | str = "cpu") -> Trainer:
    """A new training, or the one that was interrupted in `folder`.

    Args:
        chosen: model and training.
        data: tasks with a "train" split.
        folder: for checkpoints.
        device: where to compute.

    Returns:
        A trainer; its `step` says how far it is. CheckpointError where the folder holds another model or training.
    """
    model = new_model(chosen.model, chosen.training.seed).to(device)
    return Trainer(model, OnDevice(data, torch.device(device)), chosen.training, folder)
