"""Diagnostics of a hypernetwork: does the update depend on the object?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.network import in_use
from hyperplanes.utilities.files.checkpoints import CheckpointError
from hyperplanes.utilities.images.metrics import psnr
from hyperplanes.views import Views

__all__ = ["SMALLEST_SPREAD", "Diagnostics", "diagnose", "swap_gap"]

SMALLEST_SPREAD = 0.01
"""`Diagnostics.spread` below which updates are practically the same for every object, and training warns."""


@dataclass(frozen=True)
class Diagnostics:
    """How much the updates of several objects differ.

    Attributes:
        active: share of the units (of the head, and of the codes if they have an activation) whose activation has a
            positive argument for at least one object.
        norm: root mean square over objects of the norm of delta theta.
        spread: root mean square distance of the updates from their mean over objects, as a fraction of `norm`.
        swap_gap: PSNR with an object's own update minus PSNR with the update of another object, in dB, mean over
            objects; NaN if it was not measured.
    """

    active: float
    norm: float
    spread: float
    swap_gap: float = math.nan

    @property
    def constant(self) -> bool:
        """Whether the update hardly depends on the object."""
        return not self.spread >= SMALLEST_SPREAD

    def as_json(self) -> dict[str, float]:
        """The numbers that were measured, by name."""
        return {name: value for name, value in asdict(self).items() if math.isfinite(value)}

    @classmethod
    def of_json(cls, value: Mapping[str, Any], where: Path | str = "diagnostics") -> Diagnostics:
        """What `as_json` returned.

        Raises:
            CheckpointError: an entry that is missing or not a number.
        """
        names = ("active", "norm", "spread")
        found = {name: value.get(name) for name in (*names, "swap_gap") if name in names or name in value}
        if not all(isinstance(number, int | float) for number in found.values()):
            raise CheckpointError(f"{where}: expected numbers {', '.join(names)}, found {found}; train again")
        return cls(**{name: float(number) for name, number in found.items()})  # pyright: ignore[reportArgumentType]

    def __str__(self) -> str:
        parts = [
            f"updates differ by {self.spread:.1%} of their norm {self.norm:.2f}",
            f"{self.active:.0%} units active",
        ]
        if math.isfinite(self.swap_gap):
            parts.append(f"another object's update costs {self.swap_gap:.2f} dB")
        return ", ".join(parts)


@torch.no_grad()
def diagnose(model: HyperPlanes, prepared: Sequence[SupportContext]) -> Diagnostics:
    """Norm and spread of the updates of some objects, and the share of active units.

    Args:
        model: with a hypernetwork; its mode is kept.
        prepared: at least two objects.

    Returns:
        Diagnostics without the swap gap.

    Raises:
        ValueError: a model without a hypernetwork, or fewer than two objects.
    """
    if model.hypernetwork is None or len(prepared) < 2:
        what = "a model without one" if model.hypernetwork is None else f"{len(prepared)} objects"
        raise ValueError(f"diagnose: expected a hypernetwork and at least 2 objects, got {what}")
    # which units any object activates, recorded while the updates are computed
    active: list[Tensor] = []
    hooks = [
        layer.register_forward_hook(lambda module, inputs, output: active.append((output > 0).any(0).flatten()))
        for layer in model.hypernetwork.activated
    ]
    try:
        with in_use(model):
            updates = model.updates(prepared)
    finally:
        for hook in hooks:
            hook.remove()
    # (object, parameter): norm of the updates, and of their differences from the mean
    flat = torch.stack([torch.cat([value.flatten() for value in update.values()]) for update in updates])
    norm = float(flat.square().sum(1).mean().sqrt())
    spread = float((flat - flat.mean(0)).square().sum(1).mean().sqrt())
    share = float(torch.cat(active).float().mean()) if active else 1.0
    return Diagnostics(share, norm, spread / max(norm, 1e-12))


@torch.no_grad()
def swap_gap(
    model: HyperPlanes, prepared: Sequence[SupportContext], queries: Sequence[Views], own: float | None = None
) -> float:
    """The PSNR of query views that is lost with the update of another object, the next one, in dB.

    Args:
        model: with a hypernetwork, in evaluation mode.
        prepared: the objects.
        queries: views of each object to compare with.
        own: the mean PSNR with each object's own update, if known.

    Returns:
        Mean PSNR over all views with each object's own update, minus that with the next one's.
    """
    updates = model.updates(prepared)

    def quality(shift: int) -> float:
        values = []
        for index, (each, query) in enumerate(zip(prepared, queries, strict=True)):
            field = model.rendering_field(each, model.theta + updates[(index + shift) % len(updates)])
            values.append(psnr(field.render(query.cameras).images, query.images))
        return float(torch.cat(values).mean())

    return (quality(0) if own is None else own) - quality(1)
