"""A training on disk: one consistent state at any moment, whenever the power goes.

training.json                   step, curve, configuration, and the name of the file of that step; written last
training-00000500.safetensors   weights and optimisers of step 500
training-00000500.json          what training.json was at step 500, where earlier steps are kept: copied over
                                training.json, the training goes on from there
model.json, model.safetensors   the model alone, for everybody else
best/                           the model with the highest PSNR of held-out objects
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.adaptation.optimisers import Muon
from hyperplanes.utilities.checkpoints import CheckpointError, check_tensors, load_tensors, read_json, save_tensors
from hyperplanes.utilities.encoding import encode_json
from hyperplanes.utilities.files import malformed
from hyperplanes.utilities.writing import write_json

__all__ = ["Curve", "check_model", "check_whole", "load_state", "save_state"]

Curve: TypeAlias = list[dict[str, float]]

ENTRIES = {"step": int, "curve": list, "config": dict, "data": dict, "state": str}
STATE = re.compile(r"training-(\d{8,})\.safetensors")
REMEDY = "give another --out folder or the same options"


def save_state(
    folder: Path,
    model: HyperPlanes,
    optimisers: Sequence[torch.optim.Optimizer],
    step: int,
    curve: Curve,
    config: Mapping[str, Any],
    data: Mapping[str, Any],
) -> None:
    """Put a new state in the place of the last one, or beside the last ones where the configuration keeps several.

    Args:
        folder: the checkpoint.
        model: with its weights.
        optimisers: with their moments.
        step: steps done.
        curve: what was reported so far.
        config: of the training; its `keep_last` says how many states stay.
        data: what tells the objects that are trained on from others, for `load_state` to compare.
    """
    name = f"training-{step:08d}.safetensors"
    tensors = {f"model.{key}": value for key, value in model.state_dict().items()}
    for index, optimiser in enumerate(optimisers):
        for place, entries in optimiser.state_dict()["state"].items():
            tensors |= {f"{index}.{place}.{key}": torch.as_tensor(value) for key, value in entries.items()}
    save_tensors(folder / name, tensors)
    document = {"step": step, "curve": curve, "config": dict(config), "data": dict(data), "state": name}
    kept = config.get("keep_last", 1)
    beside = (folder / name).with_suffix(".json")
    if kept > 1:
        write_json(beside, document)
    else:
        beside.unlink(missing_ok=True)
    if (folder / "training.json").exists():
        model.save(folder)
        write_json(folder / "training.json", document)
    else:  # a model without training.json beside it is one that lost it, see `check_whole`
        write_json(folder / "training.json", document)
        model.save(folder)
    _delete_old(folder, name, kept)


def _delete_old(folder: Path, newest: str, kept: int) -> None:
    """Delete all states but the newest and those of the last steps before it; later ones are of a run gone back on."""
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


def load_state(
    folder: Path,
    model: HyperPlanes,
    optimisers: Sequence[torch.optim.Optimizer],
    config: Mapping[str, Any],
    may_differ: Sequence[str],
    data: Mapping[str, Any],
) -> tuple[int, Curve]:
    """Continue where `save_state` stopped: weights and moments are set.

    Args:
        folder: the checkpoint.
        model: of the same configuration.
        optimisers: over the same parameters.
        config: of the training that is to go on.
        may_differ: entries of it that a resumed training may change.
        data: as in `save_state`.

    Returns:
        The steps done, and the curve. DataError where it is another training, on other data, or where files are
        damaged, missing or do not belong together.
    """
    path = folder / "training.json"
    saved = read_json(path)
    with malformed(path, "the state of a training"):
        return _load(path, saved, model, optimisers, config, may_differ, data)


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


def _load(
    path: Path,
    saved: Mapping[str, Any],
    model: HyperPlanes,
    optimisers: Sequence[torch.optim.Optimizer],
    config: Mapping[str, Any],
    may_differ: Sequence[str],
    data: Mapping[str, Any],
) -> tuple[int, Curve]:
    folder = path.parent
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
    wanted, before = json.loads(encode_json(dict(config))), saved["config"]
    differing = [name for name in wanted if name not in may_differ and before.get(name) != wanted[name]]
    if differing:
        raise CheckpointError(
            f"{path}: expected the same training to resume, found other {', '.join(differing)}; {REMEDY}"
        )
    if not STATE.fullmatch(saved["state"]):
        raise CheckpointError(f"{path}: expected the name of a file of states, found {saved['state']!r}; {REMEDY}")
    found = load_tensors(folder / saved["state"])
    weights = {f"model.{name}": value for name, value in model.state_dict().items()}
    moments: dict[str, Tensor] = {}
    for index, optimiser in enumerate(optimisers):
        names = ("momentum",) if isinstance(optimiser, Muon) else ("step", "exp_avg", "exp_avg_sq")
        for place, parameter in enumerate(value for group in optimiser.param_groups for value in group["params"]):
            if f"{index}.{place}.{names[0]}" in found:  # absent where no gradient has reached the parameter yet
                moments |= {f"{index}.{place}.{name}": parameter for name in names if name != "step"}
                moments |= {f"{index}.{place}.{name}": torch.zeros(()) for name in names if name == "step"}
    check_tensors(folder / saved["state"], found, {**weights, **moments})
    model.load_state_dict({name: found[f"model.{name}"] for name in model.state_dict()})
    for index, optimiser in enumerate(optimisers):
        state: dict[int, dict[str, Tensor]] = {}
        for key in moments:
            group, place, name = key.split(".")
            if int(group) == index:
                state.setdefault(int(place), {})[name] = found[key]
        optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
    return saved["step"], saved["curve"]


def _is_report(row: object) -> bool:
    """Whether it can be a row of a curve; None stands for what was not measured."""
    if not isinstance(row, dict) or not isinstance(row.get("step"), int | float):
        return False
    return all(value is None or isinstance(value, int | float) for value in row.values())


def check_whole(folder: Path) -> None:
    """Refuse a folder in which a new training would replace weights.

    Raises:
        CheckpointError: weights are there, but not training.json, which says how they were trained.
    """
    if not (folder / "training.json").exists() and (folder / "model.safetensors").exists():
        kept = sorted(path.name for path in folder.glob("training-*.json"))
        remedy = f"copy {kept[-1]} over it to go on from there" if kept else "give another --out folder"
        raise CheckpointError(
            f"{folder / 'training.json'}: expected the state of the training beside its weights, found none, and a new "
            f"training would replace them; {remedy}, or --out elsewhere with --checkpoint {folder} to begin with them"
        )


def check_model(folder: Path, config: ModelConfig) -> None:
    """Refuse a folder that holds another model.

    Raises:
        CheckpointError: it holds another one; the message says in what.
    """
    path = folder / "model.json"
    if path.exists() and (differing := ModelConfig.load(folder).differences(config)):
        raise CheckpointError(
            f"{path}: expected the model that is to be trained, found other {', '.join(differing)}; {REMEDY}"
        )
