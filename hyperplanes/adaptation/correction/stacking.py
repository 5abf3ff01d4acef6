"""Pictures of a field averaged with those of the visual hull; held-out views and each pixel decide the weights."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.alignment.rotation import RotatedField
from hyperplanes.adaptation.base import AdaptedField, Pictures, attributes_of
from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.correction.held_out import MIN_VIEWS, Trial, hold_out
from hyperplanes.adaptation.correction.residuals import are_corrected
from hyperplanes.adaptation.gating import GatingNetwork
from hyperplanes.adaptation.network import HyperPlanesNetwork, in_use
from hyperplanes.configuration.fine_tuning import MANY_VIEWS
from hyperplanes.geometry.kernels.threads import run_concurrently
from hyperplanes.geometry.rays import Rays
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.renderer import Sampler
from hyperplanes.utilities.tensors.precision import without_autocast

__all__ = [
    "AveragedField",
    "Learned",
    "StackedField",
    "average",
    "best_share",
    "hull_field",
    "hull_share",
    "learned_part",
    "stack",
    "stacked_field",
    "tuned_field",
]

CAUTION = 1.5  # power of the best share for the few held-out views, to be cautious (docs/image-based.md, "Stacking")
OVERRULED = 0.8  # share of the hull above which its surface is used
MIN_ERROR_REDUCTION = 0.02  # relative reduction of the squared error that is worth a second picture

Pixels = TypeVar("Pixels", Rendered, Pictures)


@dataclass(frozen=True, repr=False)
class StackedField(AdaptedField):
    """A field whose pictures are averaged with those of another field (Wolpert 1992, "Stacked generalization").

    Densities, colours and meshes are those of the field alone.

    Attributes:
        other: the other field.
        share: of the other field in the average.
        overruled: whether the other field is the learned one, and this field the visual hull.
        gate: turns the share into one for each pixel; with None, all pixels have the same.
        views: number of support views.
    """

    other: AdaptedField = field(kw_only=True)
    share: float = field(kw_only=True)
    overruled: bool = field(default=False, kw_only=True)
    gate: GatingNetwork | None = field(default=None, kw_only=True)
    views: int = field(default=MIN_VIEWS, kw_only=True)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({super().__repr__()}, {self.share:.0%} of {self.other!r})"

    def with_sampling(self, sampling: Sampler) -> AdaptedField:
        """As `AdaptedField.with_sampling`; the visual hull keeps its own sampler."""
        own, other = self._samplers(sampling)
        return replace(
            self, sampling=own or self.sampling, other=self.other.with_sampling(other) if other else self.other
        )

    def with_penalty_at(self, centre: Float[Tensor, 3], penalty: float) -> AdaptedField:
        """As `AdaptedField.with_penalty_at`, of both fields."""
        return replace(super().with_penalty_at(centre, penalty), other=self.other.with_penalty_at(centre, penalty))

    @without_autocast
    def trace(self, rays: Rays, generator: torch.Generator | None = None, *, differentiable: bool = True) -> Rendered:
        """As `AdaptedField.trace`, averaged over both fields."""
        own = super().trace(rays, generator, differentiable=differentiable)
        if not self.share and self.gate is None:
            return own
        return self._mean(own, self.other.trace(rays, generator, differentiable=differentiable))

    def _pictures(
        self, cameras: PinholeCamera, sampling: Sampler | None, antialias: bool | None, mixed_precision: bool
    ) -> Pictures:
        of_own, of_other = self._samplers(sampling)
        own = partial(super()._pictures, cameras, of_own, antialias, mixed_precision)
        if not self.share and self.gate is None:
            return own()
        other = partial(self.other.render, cameras, of_other, antialias, mixed_precision=mixed_precision)
        if not (self.thread_safe and self.other.thread_safe):
            return self._mean(own(), other())
        return self._mean(*run_concurrently(own, other, self.occupancy.occupied.device))

    def _samplers(self, sampling: Sampler | None) -> tuple[Sampler | None, Sampler | None]:
        """The given sampler for whichever of the field and the other one is learned, None for the visual hull."""
        return (None, sampling) if self.overruled else (sampling, None)

    def _mean(self, own: Pixels, other: Pixels) -> Pixels:
        """Averages colours and opacities, and depths weighted by opacity; a depth of 0 is none and does not count."""
        share = self._shares(own, other)
        opacity = torch.lerp(own.opacity, other.opacity, share)
        mine, theirs = (each.opacity * (each.depth > 0) for each in (own, other))
        depth = torch.lerp(mine * own.depth, theirs * other.depth, share)
        depth = depth / torch.lerp(mine, theirs, share).clamp_min(1e-10)
        colour, of_colours = ("images", share) if isinstance(own, Pictures) else ("colour", share[:, None])
        colours = torch.lerp(getattr(own, colour), getattr(other, colour), of_colours)
        return replace(own, **{colour: colours}, opacity=opacity, depth=depth, samples=own.samples + other.samples)

    def _shares(self, own: Pixels, other: Pixels) -> Tensor:
        """The share of the other field in each pixel."""
        if self.gate is None:
            return torch.full_like(own.opacity, self.share)
        if self.overruled:
            return 1 - self.gate.shares(other, own, 1 - self.share, self.views)
        return self.gate.shares(own, other, self.share, self.views)


@dataclass(frozen=True, repr=False)
class AveragedField(StackedField):
    """A field after gradient steps, whose pictures are averaged with those of the field before them (`average`)."""

    def _samplers(self, sampling: Sampler | None) -> tuple[Sampler | None, Sampler | None]:
        """The given sampler for both, which are learned."""
        return sampling, sampling


@dataclass(frozen=True)
class Learned:
    """The learned part of a field.

    Attributes:
        field: of a network.
        share: of the visual hull, over all pixels.
        gate: turns the share into one for each pixel, if there is one.
        before: the field before gradient steps, if pictures are averaged with it.
        average: its share.
    """

    field: AdaptedField
    share: float = 0.0
    gate: GatingNetwork | None = None
    before: AdaptedField | None = None
    average: float = 0.0


def learned_part(adapted: AdaptedField) -> Learned:
    """The learned part of a field, and what its pictures are averaged with.

    Args:
        adapted: a field, stacked or not, in its canonical frame or in that of the scene.
    """
    if isinstance(adapted, RotatedField):
        return learned_part(adapted.unrotated)
    if not isinstance(adapted, StackedField):
        return Learned(adapted)
    if isinstance(adapted, AveragedField):
        return Learned(adapted, before=adapted.other, average=adapted.share)
    if adapted.overruled:
        return Learned(adapted.other, 1 - adapted.share, adapted.gate)
    return Learned(adapted, adapted.share, adapted.gate)


def stack(
    learned: AdaptedField, hull: AdaptedField, share: float, gate: GatingNetwork | None = None, views: int = MIN_VIEWS
) -> AdaptedField:
    """Two fields as one, whose pictures are averages of those of both.

    Densities are those of the first, from which voxels and meshes are better, unless it contributes almost nothing to
    the pictures.

    Args:
        learned: a field that is not stacked.
        hull: another one.
        share: of the second in the pictures, in [0, 1].
        gate: turns the share into one for each pixel; without it all pixels have the same.
        views: number of support views, for the gate.

    Returns:
        The first field alone if the share is 0 and there is no gate. With more than OVERRULED, the `other` of the
        result is the first field (`learned_part`).

    Raises:
        ValueError: a field that is stacked already.
    """
    if isinstance(learned, StackedField) or isinstance(hull, StackedField):
        raise ValueError("stack: expected fields that are not stacked, got one that is")
    if share == 0 and gate is None:
        return learned
    overruled = share > OVERRULED
    shown, other = (hull, learned) if overruled else (learned, hull)
    share = 1 - share if overruled else share
    own = attributes_of(shown)
    own["symmetry"] = learned.symmetry  # of the object; the hull has none
    return StackedField(**own, other=other, share=share, overruled=overruled, gate=gate, views=views)


def average(tuned: AdaptedField, before: AdaptedField, share: float) -> AdaptedField:
    """A field after gradient steps, with pictures averaged with those of the field before them.

    Steps on few views also change what no view shows, partly for the worse. The errors there differ from those of the
    field before, so an average has smaller ones (docs/adaptation.md).

    Args:
        tuned: the field after the steps, whose densities are those of the result.
        before: the field before the steps.
        share: of `before`.
    """
    return AveragedField(**attributes_of(tuned), other=before, share=share)


@torch.no_grad()
def stacked_field(network: HyperPlanesNetwork, context: SupportContext, weights: Parameters) -> AdaptedField:
    """The field of given weights, stacked with the visual hull if the model is configured so.

    The share of the hull is that for the object's own update (`hull_share`), whatever the weights are, or the one in
    the configuration. With MIN_VIEWS views or more, counting reflections, the gating network of the model, if any,
    turns it into one for each pixel.

    Args:
        network: the model.
        context: the object.
        weights: of the field.
    """
    learned = network.rendering_field(context, weights)
    if network.theta_before is not None:
        return average(learned, network.rendering_field(context, network.theta_before), network.config.average)
    if context.views.masks is None:
        return learned
    share = network.config.hull_share
    if network.config.stacked:
        with in_use(network):
            share = hull_share(hold_out(network, context.given, context.symmetry))
    gate = network.gate if len(context.views) >= MIN_VIEWS else None
    if not share and gate is None:
        return learned
    return stack(learned, hull_field(context), share, gate, len(context.views))


@torch.no_grad()
def tuned_field(
    network: HyperPlanesNetwork,
    context: SupportContext,
    weights: Parameters,
    before: Parameters | None = None,
    share: float = 0.0,
) -> AdaptedField:
    """The field of weights after gradient steps, averaged with the one before them or with the visual hull.

    The hull is used with MANY_VIEWS given views or more, not counting reflections, if the model has a gating network.
    This computes the share of each pixel from an overall share of 0, since no view is held out: gradient steps learn
    from all of them. If pictures are corrected (`residuals.are_corrected`), the hull is left out: it takes time and
    gains nothing more (docs/image-based-measurements.md).

    Args:
        network: the model.
        context: the object.
        weights: of the field.
        before: the weights before the steps, if pictures are averaged with those of their field.
        share: of that field.
    """
    tuned = network.rendering_field(context, weights)
    if before is not None:
        return average(tuned, network.rendering_field(context, before), share)
    few = context.views.masks is None or len(context.given) < MANY_VIEWS
    if network.gate is None or few or are_corrected(network, context.given):
        return tuned
    return stack(tuned, hull_field(context), 0.0, network.gate, len(context.views))


@torch.no_grad()
def hull_share(trial: Trial | None) -> float:
    """The share of `HullBlend` in the pictures of an object that is best for held-out views.

    What was learned may not fit an object of another kind, and if it does, the errors of both differ, so an average has
    smaller ones. The squared error on pixels of held-out views decides.

    Args:
        trial: with views held out (`held_out.hold_out`).

    Returns:
        The share in [0, 1]: the best one (`best_share`) to the power of CAUTION. It is 0 without a trial, or if it
        lowers the squared error by less than MIN_ERROR_REDUCTION.
    """
    if trial is None:
        return 0.0
    without, hull = (trial.pixels.errors(each) for each in (trial.learned, hull_field(trial.context)))
    share = best_share(without, hull) ** CAUTION
    mixed = torch.lerp(without, hull, share)
    return share if float(mixed.square().sum()) < (1 - MIN_ERROR_REDUCTION) * float(without.square().sum()) else 0.0


def hull_field(context: SupportContext) -> AdaptedField:
    """The field that `HullBlend` makes of an object.

    Args:
        context: of an object, for a field that takes any number of views.
    """
    assert isinstance(context.planes, VisibilityPlanes)
    return HullBlend().adapt_to(context.planes)


def best_share(one: Float[Tensor, "pixel 3"], other: Float[Tensor, "pixel 3"]) -> float:
    """The share of `other` that minimises the squared error of the average of two predictions.

    >>> best_share(torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]))
    0.5

    Args:
        one: errors of one prediction.
        other: errors of the other.

    Returns:
        The minimum of a quadratic function, in [0, 1]; 0 if both predictions are the same.
    """
    between = other - one
    return float((-(one * between).sum() / between.square().sum().clamp_min(1e-12)).clamp(0, 1))
