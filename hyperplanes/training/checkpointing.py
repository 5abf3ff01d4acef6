"""The checkpoints of a training. The files are a consistent state at any moment, even after a power failure.

training.json                   step, curve, configuration, and the name of the file of that step; written last
training-00000500.safetensors   weights and optimiser states of step 500
training-00000500.json          training.json of step 500, if earlier steps are kept; to resume from that step, copy
                                it over training.json
model.json, model.safetensors   the model alone, for everything but training
best/                           the model with the highest PSNR on held-out objects
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from hyperplanes.adaptation.diagnostics import Diagnostics
from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.adaptation.optimisation.optimisers import Muon
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.episodes import EpisodeLoader
from hyperplanes.training.optimisation import Optimisation
from hyperplanes.utilities.files.checkpoints import (
    CheckpointError,
    check_tensors,
    load_tensors,
    read_json,
    save_tensors,
)
from hyperplanes.utilities.files.encoding import encode_json
from hyperplanes.utilities.files.reading import malformed
from hyperplanes.utilities.files.writing import write_json
from hyperplanes.utilities.machine.environment import has_fast_bfloat16

__all__ = ["Checkpointing", "choose_precision"]

Curve: TypeAlias = list[dict[str, float]]

ENTRIES = {"step": int, "curve": list, "config": dict, "data": dict, "state": str}
STATE = re.compile(r"training-(\d{8,})\.safetensors")
REMEDY = "give another --out folder or the same options"

MAY_DIFFER = ("steps", "epochs", "evaluate_every", "held_out", "checkpoint_every", "keep_last", "memory", "prefetch")
"""Settings that may change when a training is resumed."""


def choose_precision(config: TrainingConfig, model: HyperPlanes, folder: Path | None) -> str:
    """The precision of a training. "automatic" is the one that the training in the folder began with, if there is one.

    Otherwise "automatic" is bfloat16 if the hypernetwork reads volumes and the CPU computes fast in bfloat16.

    Returns:
        "single" or "bfloat16".
    """
    if config.precision != "automatic":
        return config.precision
    if folder is not None and (folder / "training.json").exists():
        before = read_json(folder / "training.json").get("config")
        found = before.get("precision") if isinstance(before, dict) else None
        if found in ("single", "bfloat16"):  # other values are refused when the state is read
            return found
    suits = model.reads_volume and model.rig.device.type == "cpu" and has_fast_bfloat16()
    return "bfloat16" if suits else "single"


class Checkpointing:
    """Reads and writes the state of one training.

    Args:
        folder: the folder of the training; with None, nothing is read or written.
        model: the model that is trained.
        optimisation: its optimisers.
        config: the configuration of the training.
        writes: whether this process writes the files.

    Raises:
        CheckpointError: the folder has another model, or weights without the state of their training.
    """

    def __init__(
        self, folder: Path | None, model: HyperPlanes, optimisation: Optimisation, config: TrainingConfig, writes: bool
    ) -> None:
        self.folder, self.model, self.optimisation, self.config = folder, model, optimisation, config
        self._writes = writes and folder is not None
        if folder is not None:
            check_model(folder, model.config)
            check_whole(folder)

    @property
    def resumable(self) -> bool:
        """Whether the folder has a state to resume from."""
        return self.folder is not None and (self.folder / "training.json").exists()

    def resume(self, loader: EpisodeLoader) -> tuple[int, Curve]:
        """Set weights and optimisers to the last state, if there is one.

        Args:
            loader: the loader of the objects, which must be those that the training began with.

        Returns:
            The steps done, and the curve. DataError if the state is damaged or belongs to another training.
        """
        if self.folder is None or not self.resumable:
            return 0, []
        path = self.folder / "training.json"
        saved = read_json(path)
        with malformed(path, "the state of a training"):
            self._check(path, saved, loader.fingerprint)
            self._load(self.folder / saved["state"])
        if self._writes and not (self.folder / "model.safetensors").exists():
            self.model.save(self.folder)  # the process was killed while it wrote the first checkpoint
        return saved["step"], saved["curve"]

    def _check(self, path: Path, saved: Mapping[str, Any], data: Mapping[str, Any]) -> None:
        """Refuse the content of training.json if it is invalid, or of another training or other data."""
        for name, kind in ENTRIES.items():
            if not isinstance(saved.get(name), kind):
                found = "none" if name not in saved else type(saved[name]).__name__
                raise CheckpointError(f"{path}: expected an entry {name!r} ({kind.__name__}), found {found}; {REMEDY}")
        _compare_data(path, saved["data"], data)
        if saved["step"] < 0:
            raise CheckpointError(f"{path}: expected a number of steps, found {saved['step']}; {REMEDY}")
        if odd := [row for row in saved["curve"] if not _is_report(row)]:
            raise CheckpointError(
                f"{path}: expected a curve of numbers by name, the step among them, found {odd[0]!r:.40}; {REMEDY}"
            )
        wanted, before = json.loads(encode_json(asdict(self.config))), saved["config"]
        differing = [name for name in wanted if name not in MAY_DIFFER and before.get(name) != wanted[name]]
        if differing:
            raise CheckpointError(
                f"{path}: expected the same training to resume, found other {', '.join(differing)}; {REMEDY}"
            )
        if not STATE.fullmatch(saved["state"]):
            raise CheckpointError(f"{path}: expected the name of a file of states, found {saved['state']!r}; {REMEDY}")

    def _load(self, path: Path) -> None:
        """Set the weights and the states of the optimisers to those in a file."""
        found = load_tensors(path)
        weights = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        moments: dict[str, Tensor] = {}
        for index, optimiser in enumerate(self.optimisation.optimisers):
            names = ("momentum",) if isinstance(optimiser, Muon) else ("step", "exp_avg", "exp_avg_sq")
            for place, parameter in enumerate(value for group in optimiser.param_groups for value in group["params"]):
                if f"{index}.{place}.{names[0]}" in found:  # absent where no gradient has reached the parameter yet
                    moments |= {f"{index}.{place}.{name}": parameter for name in names if name != "step"}
                    moments |= {f"{index}.{place}.{name}": torch.zeros(()) for name in names if name == "step"}
        check_tensors(path, found, {**weights, **moments})
        self.model.load_state_dict({name: found[f"model.{name}"] for name in self.model.state_dict()})
        for index, optimiser in enumerate(self.optimisation.optimisers):
            state: dict[int, dict[str, Tensor]] = {}
            for key in moments:
                group, place, name = key.split(".")
                if int(group) == index:
                    state.setdefault(int(place), {})[name] = found[key]
            optimiser.load_state_dict({**optimiser.state_dict(), "state": state})

    def save(self, step: int, curve: Curve, diagnostics: Diagnostics | None, loader: EpisodeLoader) -> None:
        """Write the model and the state of the training; an interruption leaves the previous state valid."""
        if not self._writes or self.folder is None:
            return
        if diagnostics is not None:
            write_json(self.folder / "diagnostics.json", diagnostics.as_json())
        name = f"training-{step:08d}.safetensors"
        tensors = {f"model.{key}": value for key, value in self.model.state_dict().items()}
        for index, optimiser in enumerate(self.optimisation.optimisers):
            for place, entries in optimiser.state_dict()["state"].items():
                tensors |= {f"{index}.{place}.{key}": torch.as_tensor(value) for key, value in entries.items()}
        save_tensors(self.folder / name, tensors)
        config, data = asdict(self.config), loader.fingerprint
        document = {"step": step, "curve": curve, "config": config, "data": data, "state": name}
        beside = (self.folder / name).with_suffix(".json")
        if self.config.keep_last > 1:
            write_json(beside, document)
        else:
            beside.unlink(missing_ok=True)
        if (self.folder / "training.json").exists():
            self.model.save(self.folder)
            write_json(self.folder / "training.json", document)
        else:  # the model comes second, because `check_whole` refuses a model without training.json
            write_json(self.folder / "training.json", document)
            self.model.save(self.folder)
        _delete_old(self.folder, name, self.config.keep_last)

    def save_best(self) -> None:
        """Write the model to best/."""
        if self._writes and self.folder is not None:
            self.model.save(self.folder / "best")


def _delete_old(folder: Path, newest: str, kept: int) -> None:
    """Delete all states but the newest and the `kept` - 1 before it; later steps belong to an abandoned training."""
    states = sorted(path.name for path in folder.glob("training-*.safetensors") if STATE.fullmatch(path.name))
    earlier = [name for name in states if _step(name) < _step(newest)]
    staying = {newest, *earlier[len(earlier) - min(kept - 1, len(earlier)) :]}
    for name in states:
        if name not in staying:
            (folder / name).with_suffix(".json").unlink(missing_ok=True)
            (folder / name).unlink(missing_ok=True)


def _step(name: str) -> int:
    found = STATE.fullmatch(name)
    assert found is not None
    return int(found[1])


def _compare_data(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    differing = [name for name in now if before.get(name) != now[name]]
    if not differing:
        return
    found = f"{now['objects']} with other {' and '.join(differing)}"
    remedy = "give --legacy as before" if differing == ["calibration"] else "give the same --data"
    raise CheckpointError(
        f"{path}: expected the {before.get('objects')} objects that the training began with, found {found}; {remedy}, "
        f"or another --out with --checkpoint {path.parent} to begin with these weights"
    )


def _is_report(row: object) -> bool:
    """Whether a value is a row of a curve: numbers by name, among them the step. None means not measured."""
    if not isinstance(row, dict) or not isinstance(row.get("step"), int | float):
        return False
    return all(value is None or isinstance(value, int | float) for value in row.values())


def check_whole(folder: Path) -> None:
    """Refuse a folder in which a new training would replace weights.

    Raises:
        CheckpointError: the folder has weights, but not training.json, the state of their training.
    """
    if not (folder / "training.json").exists() and (folder / "model.safetensors").exists():
        kept = sorted(path.name for path in folder.glob("training-*.json"))
        remedy = f"copy {kept[-1]} to it to resume from there" if kept else "give another --out folder"
        raise CheckpointError(
            f"{folder / 'training.json'}: expected the state of the training beside its weights, found none, and a new "
            f"training would replace them; {remedy}, or --out elsewhere with --checkpoint {folder} to begin with them"
        )


def check_model(folder: Path, config: ModelConfig) -> None:
    """Refuse a folder that has another model.

    Raises:
        CheckpointError: the folder has another model; the message names the settings that differ.
    """
    path = folder / "model.json"
    if path.exists() and (differing := ModelConfig.load(folder).differences(config)):
        raise CheckpointError(
            f"{path}: expected the model that is to be trained, found other {', '.join(differing)}; {REMEDY}"
        )
