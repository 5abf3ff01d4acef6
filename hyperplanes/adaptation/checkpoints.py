"""Checkpoints of models: writing, finding and reading them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from hyperplanes.adaptation.hub import download_checkpoint, is_repository
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.utilities.files.checkpoints import CheckpointError, load_tensors, save_tensors
from hyperplanes.utilities.files.writing import write_json
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = [
    "checkpoint_folder",
    "find_checkpoint",
    "find_checkpoints",
    "packaged_folder",
    "read_checkpoint",
    "write_checkpoint",
]

PACKAGED = Path(__file__).parent.parent / "pretrained"  # one folder per model, named after it

Model = TypeVar("Model", bound=nn.Module)


def write_checkpoint(folder: Path | str, config: ModelConfig, weights: Mapping[str, Tensor]) -> None:
    """Write model.json and model.safetensors.

    Args:
        folder: created if absent.
        config: of the model.
        weights: by name.
    """
    save_tensors(Path(folder) / "model.safetensors", weights)
    write_json(Path(folder) / "model.json", config.as_json())


def read_checkpoint(name: Path | str, make: Callable[[ModelConfig], Model]) -> Model:
    """The model that `write_checkpoint` wrote.

    Args:
        name: its folder, or the name of a packaged model.
        make: makes the model of a configuration; its weights are replaced.

    Returns:
        The model, ready for use.

    Raises:
        CheckpointError: no such folder or name, a missing or damaged file, or weights that do not fit the
            configuration, for which nothing is allocated.
    """
    folder = checkpoint_folder(name)
    config = ModelConfig.load(folder)
    try:
        with torch.device("meta"):  # names and shapes alone, to compare with the file
            model = make(config)
    except ValueError as error:
        raise CheckpointError(f"{folder / 'model.json'}: {error}; train again with this version") from None
    expected = model.state_dict()
    weights = load_tensors(folder / "model.safetensors", expected)
    model.load_state_dict({name: weights[name].to(value.dtype) for name, value in expected.items()}, assign=True)
    return model.eval()


def packaged_folder(name: str) -> Path:
    """The folder of a model that comes with the package, whatever the current folder contains."""
    return PACKAGED / name


def checkpoint_folder(name: Path | str) -> Path:
    """The folder of a checkpoint, given by its path, the name of a packaged model, or a repository on the hub.

    Raises:
        CheckpointError: a file, or a name that is neither a folder nor a packaged model.
    """
    folder = Path(name)
    if is_repository(str(name)):
        return download_checkpoint(str(name))
    if folder.is_file():
        raise CheckpointError(f"{name}: expected a checkpoint's folder, got a file; name the folder that it is in")
    if folder.exists() or len(folder.parts) != 1:
        return folder
    packaged = sorted(path.parent.name for path in PACKAGED.glob("*/model.json"))
    if folder.name not in packaged:
        known = ", ".join(packaged) or "this installation has none"
        raise CheckpointError(
            f"{name}: expected a checkpoint's folder or the name of a packaged model ({known}), found neither"
            + (did_you_mean(folder.name, packaged) or "; `hyperplanes train` writes a checkpoint")
        )
    return packaged_folder(folder.name)


def find_checkpoints(folders: Sequence[Path]) -> dict[str, Path]:
    """Checkpoints by the method that trained them.

    Args:
        folders: each a checkpoint, a folder of checkpoints such as `runs/demo`, or the name of a packaged model.

    Returns:
        Folders by the names of their methods, such as "hyperplanes".

    Raises:
        CheckpointError: a folder without a checkpoint, or two checkpoints of the same method.
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
            method = ModelConfig.load(path).method
            other = found.setdefault(method, path)
            if other.resolve() != path.resolve():
                raise CheckpointError(
                    f"checkpoint: expected one of each method, got {other} and {path}, which are both {method}; "
                    "give one of them at a time"
                )
    return found


def find_checkpoint(folder: Path) -> Path:
    """The checkpoint at a path; in a folder of several, that of HyperPlanes.

    Raises:
        CheckpointError: no checkpoint, or several of which none is of HyperPlanes.
    """
    found = find_checkpoints([folder])
    if "hyperplanes" not in found and len(found) > 1:
        raise CheckpointError(f"{folder}: expected one checkpoint, found {', '.join(sorted(found))}; name one of them")
    return found.get("hyperplanes") or next(iter(found.values()))
