"""A disk cache of what is computed from views, keyed by a hash of its inputs, so that two commands share results.

Adapted fields are in `$HYPERPLANES_CACHE/adapted`, by default `~/.cache/hyperplanes/adapted`, with refined poses and
learned backgrounds beside them. All of it may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.utilities.files.checkpoints import load_tensors, save_tensors
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.machine.environment import cache_folder
from hyperplanes.views import Views

__all__ = ["keep_field", "keep_tensors", "kept_file", "kept_folder", "recall_field", "recall_tensors"]

MAX_ENTRIES = 10  # entries of a kind; the oldest is deleted first


def kept_folder(model: HyperPlanes, views: Views, steps: Steps, settings: FineTuning) -> Path:
    """The folder for the field of these weights, views and options, which may not exist.

    Args:
        model: the model that adapts.
        views: the support views.
        steps: of fine-tuning.
        settings: of fine-tuning.
    """
    options = [model.config.as_json(), str(steps), repr(settings)]
    return _home() / "adapted" / _digest(options, views, _weights(model))


def kept_file(kind: str, views: Views, model: HyperPlanes | None = None, *options: object) -> Path:
    """The file for tensors computed from views, which may not exist.

    Args:
        kind: of tensors, the name of a folder.
        views: the input.
        model: that they also depend on, if any.
        options: other inputs that JSON can represent.
    """
    options = (*options, None if model is None else model.config.as_json())
    return _home() / kind / f"{_digest(options, views, [] if model is None else _weights(model))}.safetensors"


def keep_tensors(file: Path, tensors: Mapping[str, Tensor]) -> None:
    """Save tensors; of more than ten such files the oldest are deleted.

    Args:
        file: of `kept_file`.
        tensors: by their names.
    """
    save_tensors(file, dict(tensors))
    _delete_oldest(file.parent)


def recall_tensors(file: Path, names: Sequence[str]) -> dict[str, Tensor] | None:
    """The saved tensors, or None if the file is missing, cannot be read, or holds other tensors.

    Args:
        file: of `kept_file`.
        names: of the expected tensors.
    """
    try:
        found = load_tensors(file) if file.exists() else {}
    except DataError:
        return None
    return found if set(found) == set(names) else None


def _home() -> Path:
    return Path(os.environ.get("HYPERPLANES_CACHE") or cache_folder() / "hyperplanes")


def _weights(model: HyperPlanes) -> Iterator[Tensor]:
    yield from (value for _, value in sorted(model.state_dict().items()))


def _digest(options: Iterable[object], views: Views, weights: Iterable[Tensor]) -> str:
    """A hash of all inputs and of the code."""
    digest = hashlib.sha256(_code().encode())
    digest.update(json.dumps([*options, repr(views.bounds)]).encode())
    for part in (*weights, *_parts(views)):
        digest.update(f"{part.dtype}{tuple(part.shape)}".encode())
        digest.update(part.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()[:32]


def _parts(views: Views) -> Iterator[Tensor]:
    cameras = views.cameras
    yield from (views.images, cameras.intrinsics, cameras.extrinsics)
    distortion = getattr(cameras, "distortion", None)
    yield from (part for part in (views.masks, distortion) if isinstance(part, Tensor))


def _delete_oldest(folder: Path) -> None:
    others = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)
    for path in others[:-MAX_ENTRIES]:
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


@cache
def _code() -> str:
    """A hash of the files of the package, so that results of other versions are not used."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def keep_field(model: HyperPlanes, field: AdaptedField, folder: Path) -> None:
    """Save a field; of more than ten the oldest are deleted.

    Args:
        model: the model that made it.
        field: the field.
        folder: of `kept_folder`.
    """
    model.with_weights_of(field).save(folder)
    _delete_oldest(folder.parent)


def recall_field(folder: Path, views: Views, device: torch.device | str = "cpu") -> AdaptedField | None:
    """The saved field, or None if there is none or it cannot be read.

    Args:
        folder: of `kept_folder`.
        views: as in `kept_folder`.
        device: of the field.
    """
    if not (folder / "model.json").exists():
        return None
    try:
        model = HyperPlanes.from_pretrained(folder).to(device)
    except DataError:
        return None
    with torch.no_grad():
        return model.adapt(views)
