"""Adapted fields kept on disk by what they were made of, so that two commands on the same views adapt once.

They lie in `$HYPERPLANES_CACHE/adapted`, by default `~/.cache/hyperplanes/adapted`, which may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.utilities.checkpoints import CheckpointError, load_tensors, save_tensors
from hyperplanes.utilities.environment import cache_folder
from hyperplanes.views import Views

__all__ = ["keep_field", "kept_folder", "recall_field"]

MOST = 10  # fields that are kept; the oldest goes first
SURFACE = "surface.safetensors"


def kept_folder(model: HyperPlanes, views: Views, steps: Steps, settings: FineTuning) -> Path:
    """Where the field of these weights, views and options is kept, whether it is there or not.

    Args:
        model: what adapts.
        views: the support views.
        steps: of fine-tuning.
        settings: of fine-tuning.
    """
    digest = hashlib.sha256(_code().encode())
    digest.update(json.dumps([model.config.as_json(), str(steps), repr(settings), repr(views.bounds)]).encode())
    for part in _tensors(model, views):
        digest.update(f"{part.dtype}{tuple(part.shape)}".encode())
        digest.update(part.detach().cpu().contiguous().numpy().tobytes())
    base = Path(os.environ.get("HYPERPLANES_CACHE") or cache_folder() / "hyperplanes")
    return base / "adapted" / digest.hexdigest()[:32]


def _tensors(model: HyperPlanes, views: Views) -> Iterator[Tensor]:
    yield from (value for _, value in sorted(model.state_dict().items()))
    cameras = views.cameras
    yield from (views.images, cameras.intrinsics, cameras.extrinsics)
    distortion = getattr(cameras, "distortion", None)
    yield from (part for part in (views.masks, distortion) if isinstance(part, Tensor))


@cache
def _code() -> str:
    """A hash of the package's own files: what another version adapted is not taken for what this one would."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.parent.glob("**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def keep_field(model: HyperPlanes, field: AdaptedField, folder: Path) -> None:
    """Keep a field; of more than ten the oldest are deleted.

    Args:
        model: what made it.
        field: of `model`.
        folder: of `kept_folder`.
    """
    surface = _surface(field)
    if surface is not None:
        save_tensors(folder / SURFACE, {"distances": surface.cpu()})
    model.with_weights_of(field).save(folder)
    others = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime)
    for path in others[:-MOST]:
        shutil.rmtree(path, ignore_errors=True)


def recall_field(folder: Path, views: Views, device: torch.device | str = "cpu") -> AdaptedField | None:
    """The field that was kept, or None where none was, or one that cannot be read.

    Args:
        folder: of `kept_folder`.
        views: the same as there.
        device: where the field goes.
    """
    if not (folder / "model.json").exists():
        return None
    try:
        model = HyperPlanes.from_pretrained(folder).to(device)
        kept = load_tensors(folder / SURFACE) if (folder / SURFACE).exists() else {}
    except CheckpointError:
        return None
    context = model.prepare(views)
    if "distances" in kept:
        distances = kept["distances"].to(device)
        planes = model.target.with_surface(context.planes, distances, torch.ones_like(distances))
        context = replace(context, planes=planes)
    with torch.no_grad():
        return model.field(context, model.theta.detach())


def _surface(field: AdaptedField) -> Tensor | None:
    planes = getattr(field.field, "planes", None)
    return planes.surface if isinstance(planes, VisibilityPlanes) else None
