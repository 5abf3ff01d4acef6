"""Fine-tuning: some steps of gradient descent on the support views of one object (HyperPlanes, section 3)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import torch
from jaxtyping import Int
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.optimisers import make_optimisers
from hyperplanes.hypernetwork.choices import check_choices
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.views import Views

__all__ = ["GRID_RATES", "FineTuning", "Hiding", "Steps", "best_stop", "minimise", "ray_loss"]

Steps: TypeAlias = int | Literal["auto"]

Hiding: TypeAlias = Callable[[Int[Tensor, " hidden"] | None], AdaptedField]
"""The field that some variables make, to which the support views of these indices, if any, are not shown."""

JUDGED = 4096  # rays of left-out views that "auto" compares
CHECKS = 10  # times that it compares them

RATES: dict[str, tuple[str, float, float]] = {
    "weights": ("muon", 2e-3, 0.04),
    "hypernetwork": ("adam", 3e-4, 0.0),
}
"""What is optimised: by which optimiser, the learning rate of Adam, that of Muon. Chosen by measurement, see
docs/adaptation.md."""

GRID_RATES = {"learning_rate": 2e-2, "muon_learning_rate": 0.05}
"""Of the weights of a field with a grid of features, trained or random; docs/any_order.md."""


@dataclass(frozen=True)
class FineTuning:
    """How a field is fine-tuned.

    Attributes:
        free: what is optimised: "weights", theta + delta itself, or "hypernetwork", a copy of the hypernetwork while
            theta is frozen, as in the paper.
        rays: a step, drawn from all support views.
        optimiser: "muon", "adam" or "sgd"; the best for what is free, see RATES, where None.
        learning_rate: of Adam or of plain gradient descent at the first step; that of RATES where None, or of
            GRID_RATES.
        muon_learning_rate: of Muon at the first step; likewise.
        final: what the rates fall to along half a cosine, as a fraction.
        longest: the most steps that "auto" may choose.
        left_out: every so many-th support view is left out of the planes and of the rays while "auto" chooses.
        hide: a field that takes any number of views is not shown those that the rays of a step come from, a share
            `1 / left_out` of them, as it could copy their colours; a single view cannot be hidden.
        seed: of rays and samples.

    Raises:
        ValueError: an unknown name, no ray, a rate that is negative or not finite, or every view left out.
    """

    free: Literal["weights", "hypernetwork"] = "weights"
    rays: int = 1024
    optimiser: Literal["adam", "muon", "sgd"] | None = None
    learning_rate: float | None = None
    muon_learning_rate: float | None = None
    final: float = 0.1
    longest: int = 300
    left_out: int = 6
    hide: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        check_choices(self, {"free": RATES, "optimiser": (None, "adam", "muon", "sgd")})
        for name, least in (("rays", 1), ("longest", 1), ("left_out", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        for name in ("learning_rate", "muon_learning_rate", "final"):
            rate = getattr(self, name)
            if rate is not None and not 0 <= rate < math.inf:
                raise ValueError(f"{name}: expected a finite number of 0 or more, got {rate}")

    def with_rates(self, rates: Mapping[str, float]) -> FineTuning:
        """The settings with these rates where they state none; `rates` are fields of the settings by name."""
        return replace(self, **{name: rate for name, rate in rates.items() if getattr(self, name) is None})

    def optimisers(self, variables: Sequence[Tensor]) -> list[torch.optim.Optimizer]:
        """The optimisers of what is free, at the rates of the first step."""
        name, adam, muon = RATES[self.free]
        return make_optimisers(
            variables,
            self.optimiser or name,
            adam if self.learning_rate is None else self.learning_rate,
            muon if self.muon_learning_rate is None else self.muon_learning_rate,
            betas=(0.9, 0.99),
        )

    def schedule(self, step: int, steps: int) -> float:
        """What the rates are multiplied with at a step, counted from 0."""
        return self.final + (1 - self.final) * (1 + math.cos(math.pi * step / max(1, steps))) / 2


def ray_loss(seen: Rendered, truth: Tensor) -> Tensor:
    """Mean squared error of the colours of rays, that of the coarse pass added where there was one (Eq. 2)."""
    loss = (seen.colour - truth).square().mean()
    return loss if seen.coarse is None else loss + (seen.coarse.colour - truth).square().mean()


def minimise(
    field: Hiding,
    variables: Sequence[Tensor],
    support: Views,
    steps: int,
    settings: FineTuning,
    *,
    pixels: Int[Tensor, " pixel"] | None = None,
    hiding: bool = False,
) -> Iterator[int]:
    """Gradient steps on the squared error of rays of the support views.

    Args:
        field: the field that the variables make.
        variables: what is optimised, in place.
        support: where rays and their colours come from.
        steps: length of the schedule.
        settings: rays, rates and seed.
        pixels: flat indices (view, row, column) to draw from, ascending; all where absent.
        hiding: hide the views that the rays of a step come from, as `settings.hide` says.

    Yields:
        The number of steps done: 0, and after each step of the schedule one more.
    """
    optimisers = settings.optimisers(variables)
    rates = [optimiser.param_groups[0]["lr"] for optimiser in optimisers]
    generator = torch.Generator().manual_seed(settings.seed)
    hiding = hiding and settings.hide and len(support) > 1
    yield 0
    for step in range(steps):
        with torch.enable_grad():
            hidden = _hidden(support, settings, generator, pixels) if hiding else None
            among = _pixels_of(hidden, support, pixels) if hidden is not None else pixels
            made = field(hidden)
            rays, truth = support.sample_rays(settings.rays, generator=generator, among=among, span=made.sampling.span)
            loss = ray_loss(made.trace(rays, generator), truth)
            for variable in variables:
                variable.grad = None
            loss.backward()
            for optimiser, rate in zip(optimisers, rates, strict=True):
                optimiser.param_groups[0]["lr"] = rate * settings.schedule(step, steps)
                optimiser.step()
        yield step + 1


def _hidden(
    support: Views, settings: FineTuning, generator: torch.Generator, pixels: Int[Tensor, " pixel"] | None
) -> Int[Tensor, " hidden"]:
    """The views that a step draws rays from, among those that have a pixel to draw."""
    area = support.size[0] * support.size[1]
    drawn = torch.randperm(len(support), generator=generator).to(support.images.device)
    if pixels is not None:
        edges = torch.searchsorted(pixels, torch.arange(len(support) + 1, device=pixels.device) * area)
        drawn = drawn[(edges.diff() > 0)[drawn]]
    return drawn[: max(1, len(support) // settings.left_out)]


def _pixels_of(
    views: Int[Tensor, " chosen"], support: Views, pixels: Int[Tensor, " pixel"] | None
) -> Int[Tensor, " among"]:
    """Flat indices of the pixels of some views: all of them, or those of `pixels`."""
    area = support.size[0] * support.size[1]
    if pixels is None:
        return (views[:, None] * area + torch.arange(area, device=views.device)).flatten()
    edges = torch.searchsorted(pixels, torch.stack([views, views + 1], 1) * area)
    return torch.cat([pixels[start:stop] for start, stop in edges.tolist()])


def best_stop(
    field: Hiding,
    variables: Sequence[Tensor],
    support: Views,
    left_out: Views,
    settings: FineTuning,
    *,
    pixels: Int[Tensor, " pixel"] | None = None,
    judged: Int[Tensor, " judged"] | None = None,
    hiding: bool = False,
    on_step: Callable[[int], None] | None = None,
) -> int:
    """After how many steps of a schedule of `settings.longest` the field shows left-out views best; 0 for none.

    Judged on the squared error of the same JUDGED rays at 0 steps and at every CHECKS-th part of the schedule; ends
    early after three checks without improvement.

    Args:
        field: as in `minimise`.
        variables: as in `minimise`.
        support: the views that rays are drawn from.
        left_out: the views that decide.
        settings: as in `minimise`.
        pixels: as in `minimise`.
        judged: flat indices of the pixels of `left_out` that count.
        hiding: as in `minimise`.
        on_step: called with the number of steps done, before the first and after each.

    Returns:
        A number of steps.
    """
    generator = torch.Generator().manual_seed(settings.seed + 1)
    with torch.no_grad():
        made = field(None)
        rays, truth = left_out.sample_rays(JUDGED, generator=generator, among=judged, span=made.sampling.span)
    errors: dict[int, float] = {}
    every = max(1, settings.longest // CHECKS)

    best = 0
    for step in minimise(field, variables, support, settings.longest, settings, pixels=pixels, hiding=hiding):
        if on_step is not None:
            on_step(step)
        if step not in (0, every // 3, settings.longest) and step % every:
            continue
        with torch.no_grad():
            error = float((field(None).trace(rays).colour - truth).square().mean())
        errors[step] = error if math.isfinite(error) else math.inf
        best = min(errors, key=lambda each: errors[each])
        if step - best > 2 * every:
            break
    return best
