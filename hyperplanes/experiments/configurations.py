"""The configuration of a training: a preset, what the experiment changes, what the scale changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

from hyperplanes.configuration.presets import Preset, configure, preset
from hyperplanes.experiments.scales import Scale
from hyperplanes.experiments.tables import Experiment, Trained

__all__ = ["change", "configuration", "deviations", "scaled_preset"]

Value = TypeVar("Value")


def change(value: Value, changes: Mapping[str, object]) -> Value:
    """A dataclass with some entries changed, by their dotted names; entries of a part that is None are left out.

    Raises:
        ValueError: no such entry.
    """
    parts: dict[str, dict[str, object]] = {}
    for name, new in changes.items():
        first, _, rest = name.partition(".")
        if not hasattr(value, first):
            raise ValueError(f"changes: expected an entry of {type(value).__name__}, got {name!r}")
        parts.setdefault(first, {})[rest] = new
    made: dict[str, Any] = {}
    for first, inside in parts.items():
        part = getattr(value, first)
        if "" in inside:
            made[first] = inside[""]
        elif part is not None:
            made[first] = change(part, inside)
    return replace(value, **made)  # pyright: ignore[reportArgumentType, reportCallIssue]


def configuration(experiment: Experiment, trained: Trained, scale: Scale, objects: int, seed: int) -> Preset:
    """Model and training of one model of an experiment.

    Args:
        experiment: which decides the preset and the paper's epochs.
        trained: the model.
        scale: how large.
        objects: that it is trained on; an epoch is a step of each.
        seed: of the training.

    Returns:
        A preset that nobody has named.
    """
    chosen = scaled_preset(experiment, scale).by_method(trained.method)
    steps = scale.steps if scale.steps is not None else experiment.epochs_of(trained.on) * objects
    changes = {**trained.changes, "training.steps": steps, "training.seed": seed}
    changes["model.network.planes"] = scale.planes(trained.planes)
    for part in ("hypernetwork", "autoencoder"):
        reader, name = getattr(chosen.model, part), f"model.{part}.views"
        if hasattr(reader, "views"):
            views = trained.changes.get(name, reader.views)
            assert isinstance(views, int)
            changes[name] = scale.planes(views)
    return change(chosen, changes)


def scaled_preset(experiment: Experiment, scale: Scale) -> Preset:
    """The preset of an experiment with what the scale changes, before a method is chosen."""
    return change(preset(scale.presets[experiment.size]), scale.changes).by_protocol(scale.protocol)


def deviations(experiment: Experiment, scale: Scale) -> list[str]:
    """What a scale does otherwise than the paper's Appendix B, entry by entry.

    Args:
        experiment: of the paper.
        scale: that it is run at.

    Returns:
        Names and values of HyperPlanes such as "model.network.width 128 (paper 256)", none at the scale of the paper.
    """
    first = next(each for each in experiment.trainings if each.method == "hyperplanes")
    name = {128: "paper-128", 200: "paper-200"}[experiment.size]
    paper = configure(name, first.method, protocol="paper")
    ours = configuration(experiment, first, scale, 1, 0)
    varied = {name for trained in experiment.trainings for name in trained.changes}
    found = []
    for part in ("model", "training"):
        mine, theirs = _flat(getattr(ours, part)), _flat(getattr(paper, part))
        for entry in sorted(mine.keys() | theirs.keys()):
            if mine.get(entry) != theirs.get(entry) and entry not in IGNORED and f"{part}.{entry}" not in varied:
                found.append(f"{part}.{entry} {_shown(mine.get(entry))} (paper {_shown(theirs.get(entry))})")
    return found


IGNORED = ("steps", "seed", "evaluate_every", "checkpoint_every", "held_out", "memory", "hull_resolution")


def _shown(value: object) -> str:
    return "-" if value is None else " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _flat(value: object, prefix: str = "") -> dict[str, object]:
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is None:
        return {prefix.removesuffix("."): value}
    flat: dict[str, object] = {}
    for name in fields:
        flat |= _flat(getattr(value, name), f"{prefix}{name}.")
    if prefix:
        flat[prefix.removesuffix(".")] = type(value).__name__
    return flat
