"""The configuration of a training: a preset with the changes of the experiment and of the scale."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from hyperplanes.configuration.fine_tuning import RATES
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.configuration.presets import Preset, preset
from hyperplanes.experiments.paper.experiment import Experiment, Trained
from hyperplanes.experiments.paper.published import SOURCES
from hyperplanes.experiments.paper.scales import Scale

__all__ = ["DIFFERENCE_HEADINGS", "Difference", "change", "configuration", "differences", "scaled_preset"]

Value = TypeVar("Value")


def change(value: Value, changes: Mapping[str, object]) -> Value:
    """A copy of a dataclass with some entries changed.

    Args:
        value: the dataclass.
        changes: the new values by dotted names; entries of a part that is None are ignored.

    Raises:
        ValueError: an unknown entry.
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
    """The configuration of one training of an experiment.

    Args:
        experiment: the experiment, which determines the preset and the paper's epochs.
        trained: the training.
        scale: the scale of the experiment.
        objects: the number of training objects; an epoch has one step for each.
        seed: the seed of the training.

    Returns:
        The configuration of the model and of its training.
    """
    learned = trained.method in LEARNED
    chosen = scaled_preset(experiment, scale).by_method(trained.method, scale.learned_target if learned else None)
    steps = scale.steps if scale.steps is not None else experiment.epochs_of(trained.on) * objects
    changes = {"training.steps": steps, **(scale.learned if learned else {}), **trained.changes, "training.seed": seed}
    changes["model.network.planes"] = scale.planes(trained.planes)
    for part in ("hypernetwork", "autoencoder"):
        reader, name = getattr(chosen.model, part), f"model.{part}.views"
        if hasattr(reader, "views"):
            views = trained.changes.get(name, reader.views)
            assert isinstance(views, int)
            changes[name] = scale.planes(views)
    return change(chosen, changes)


def scaled_preset(experiment: Experiment, scale: Scale) -> Preset:
    """The preset of an experiment with the changes of the scale, before a method is chosen."""
    return change(preset(scale.presets[experiment.size]), scale.changes).by_protocol(scale.protocol)


@dataclass(frozen=True)
class Difference:
    """A setting for which a source states another value than the one used here.

    Attributes:
        kind: the kind of method: "HyperPlanes", "fine-tuning" or "learned initialisations".
        entry: the dotted name of the setting.
        here: the value used here.
        sources: the values that `published.SOURCES` state, in that order; "-" if a source states none.
    """

    kind: str
    entry: str
    here: str
    sources: tuple[str, ...]

    @property
    def row(self) -> list[str]:
        """The cells of a table, under DIFFERENCE_HEADINGS."""
        return [self.kind, self.entry, self.here, *self.sources]


DIFFERENCE_HEADINGS = ("of", "setting", "here", *(source.name for source in SOURCES))


def differences(experiment: Experiment, scale: Scale) -> list[Difference]:
    """The settings of an experiment for which a source states another value.

    Only HyperPlanes, their fine-tuning and learned initialisations are compared: no source states settings of
    MultiPlaneNeRF, of the autoencoder or of a NeRF from random weights.

    Args:
        experiment: the experiment.
        scale: its scale.

    Returns:
        The differences, in the order of the facts of the sources, without settings that the experiment varies.
    """
    varied = {name for trained in experiment.trainings for name in trained.changes}
    found = []
    for kind, here in _settings(experiment, scale).items():
        entries = dict.fromkeys(fact.entry for source in SOURCES for fact in source.facts.get(kind, ()))
        for entry in entries:
            facts = [source.fact(kind, entry, experiment.size) for source in SOURCES]
            mine = here.get(entry)
            if entry not in varied and any(fact is not None and fact.value != mine for fact in facts):
                stated = tuple("-" if fact is None else _shown(fact.value) for fact in facts)
                found.append(Difference(kind, entry, _shown(mine), stated))
    return found


def _settings(experiment: Experiment, scale: Scale) -> dict[str, dict[str, object]]:
    """By each kind of method in an experiment, its settings by their dotted names."""
    found: dict[str, dict[str, object]] = {}
    for cell in experiment.cells:
        method, tuning = cell.trained.method, re.fullmatch(r"hyperplanes_\d+", cell.method)
        if cell.trained.packaged:
            continue
        if method == "hyperplanes" or method in LEARNED:
            kind = "HyperPlanes" if method == "hyperplanes" else "learned initialisations"
            if kind not in found:
                made = configuration(experiment, replace(cell.trained, changes={}), scale, 1, 0)
                found[kind] = _flat(made)
            if steps := re.fullmatch(r".+_(\d+)", scale.method(cell.method)):
                found[kind]["views.steps"] = int(steps[1])
            if cell.views is not None and experiment.published_row(cell.row):
                found[kind]["views.shown"] = scale.planes(cell.views)
        if tuning and cell.trainable == "hypernetwork":
            tuned = _flat(scale.fine_tuning, "fine_tuning.")
            optimiser, rate, _ = RATES["hypernetwork"]
            stated = {"fine_tuning.optimiser": optimiser, "fine_tuning.learning_rate": rate}
            tuned |= {name: value for name, value in stated.items() if tuned[name] is None}
            found["fine-tuning"] = tuned | {"fine_tuning.trainable": cell.trainable}
    return found


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


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
