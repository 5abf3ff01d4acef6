"""Pictures of a field averaged with those of the visual hull, by shares that held-out views and each pixel decide."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField, Pictures
from hyperplanes.adaptation.context import SupportContext
from hyperplanes.adaptation.gating import GatingNetwork
from hyperplanes.adaptation.held_out import FEWEST, Trial, hold_out
from hyperplanes.adaptation.hull_blend import HullBlend
from hyperplanes.adaptation.network import HyperPlanesNetwork, in_use
from hyperplanes.adaptation.residuals import are_corrected
from hyperplanes.adaptation.rotation import RotatedField
from hyperplanes.configuration.fine_tuning import MANY_VIEWS
from hyperplanes.geometry.kernels.threads import at_once
from hyperplanes.geometry.rays import Rays
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.compositing import Rendered
from hyperplanes.rendering.renderer import Sampler
from hyperplanes.utilities.arguments import checked
from hyperplanes.utilities.precision import without_autocast

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

CAUTION = 1.5  # power of the share that shows held-out views best: few views, so less (docs/image-based.md, "Stacking")
OVERRULED = 0.8  # share of the hull from which on it is its surface that counts
MARGIN = 0.02  # of the squared error, by which it has to be lower to be worth a second picture

Pixels = TypeVar("Pixels", Rendered, Pictures)


@dataclass(frozen=True, repr=False)
class StackedField(AdaptedField):
    """A field whose pictures are means of its own and of those of another one (Wolpert 1992, "Stacked generalization").

    Densities, colours and meshes are those of the field alone.

    Attributes:
        other: the other field.
        share: of the pictures of the other field in the mean.
        overruled: whether the other field is the learned one, and the field itself the visual hull.
        gate: what makes a share of every pixel of that; None leaves all alike.
        views: how many are shown.
    """

    other: AdaptedField = field(kw_only=True)
    share: float = field(kw_only=True)
    overruled: bool = field(default=False, kw_only=True)
    gate: GatingNetwork | None = field(default=None, kw_only=True)
    views: int = field(default=FEWEST, kw_only=True)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({super().__repr__()}, {self.share:.0%} of {self.other!r})"

    def with_sampling(self, sampling: Sampler) -> AdaptedField:
        """As `AdaptedField.with_sampling`; the visual hull keeps its own sampler."""
        own, other = self._samplers(sampling)
        return replace(
            self, sampling=own or self.sampling, other=self.other.with_sampling(other) if other else self.other
        )

    @without_autocast
    def trace(self, rays: Rays, generator: torch.Generator | None = None, *, differentiable: bool = True) -> Rendered:
        """The mean of the pixels of both, as `AdaptedField.trace`."""
        own = super().trace(rays, generator, differentiable=differentiable)
        if not self.share and self.gate is None:
            return own
        return self._mean(own, self.other.trace(rays, generator, differentiable=differentiable))

    @checked
    @without_autocast
    @torch.no_grad()
    def render(
        self,
        cameras: PinholeCamera,
        sampling: Sampler | None = None,
        antialias: bool | None = None,
        *,
        mixed_precision: bool = True,
    ) -> Pictures:
        """The mean of the pictures of both, as `AdaptedField.render`; the visual hull keeps its own sampler."""
        of_own, of_other = self._samplers(sampling)
        own = partial(super().render, cameras, of_own, antialias, mixed_precision=mixed_precision)
        if not self.share and self.gate is None:
            return own()
        other = partial(self.other.render, cameras, of_other, antialias, mixed_precision=mixed_precision)
        if not (self.thread_safe and self.other.thread_safe):
            return self._mean(own(), other())
        return self._mean(*at_once(own, other, self.occupancy.occupied.device))

    def _samplers(self, sampling: Sampler | None) -> tuple[Sampler | None, Sampler | None]:
        """The given sampler for whichever of the field and the other one is learned, None for the visual hull."""
        return (None, sampling) if self.overruled else (sampling, None)

    def _mean(self, own: Pixels, other: Pixels) -> Pixels:
        """The mean of colours and opacities, and the expected distance of what both show."""
        share = self._shares(own, other)
        opacity = torch.lerp(own.opacity, other.opacity, share)
        depth = torch.lerp(own.opacity * own.depth, other.opacity * other.depth, share) / opacity.clamp_min(1e-10)
        colour, of_colours = ("images", share) if isinstance(own, Pictures) else ("colour", share[:, None])
        colours = torch.lerp(getattr(own, colour), getattr(other, colour), of_colours)
        return replace(own, **{colour: colours}, opacity=opacity, depth=depth, samples=own.samples + other.samples)

    def _shares(self, own: Pixels, other: Pixels) -> Tensor:
        """Of the other field in each pixel."""
        if self.gate is None:
            return torch.full_like(own.opacity, self.share)
        if self.overruled:
            return 1 - self.gate.shares(other, own, 1 - self.share, self.views)
        return self.gate.shares(own, other, self.share, self.views)


@dataclass(frozen=True, repr=False)
class AveragedField(StackedField):
    """A field after gradient steps, whose pictures are means with those of the field before them (`average`)."""

    def _samplers(self, sampling: Sampler | None) -> tuple[Sampler | None, Sampler | None]:
        """The given sampler for both, which are learned."""
        return sampling, sampling


@dataclass(frozen=True)
class Learned:
    """The part of a field that is a network.

    Attributes:
        field: with what renders it.
        share: of the hull beside it, over all pixels.
        gate: what makes a share of every pixel of that, if anything does.
        before: the field before gradient steps, if it is in the pictures.
        average: its share.
    """

    field: AdaptedField
    share: float = 0.0
    gate: GatingNetwork | None = None
    before: AdaptedField | None = None
    average: float = 0.0


def learned_part(adapted: AdaptedField) -> Learned:
    """The part of a field that is a network, and what is beside it.

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
    learned: AdaptedField, hull: AdaptedField, share: float, gate: GatingNetwork | None = None, views: int = FEWEST
) -> AdaptedField:
    """Two fields as one: it has the mean of the pictures of both.

    Densities are those of the first one, from which voxels and meshes come out better, unless next to nothing is left
    of it in the pictures.

    Args:
        learned: a field that is not stacked.
        hull: another one.
        share: of the second one in the pictures, in [0, 1].
        gate: what makes a share of every pixel of that; without it all pixels are alike.
        views: how many are shown, for the gate.

    Returns:
        The first one alone where the share is 0 and there is no gate; with more than OVERRULED the `other` of the
        result is the first one (`learned_part`).

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
    own = {each.name: getattr(shown, each.name) for each in fields(shown)}
    own["symmetry"] = learned.symmetry  # that of the object, which the hull does not know
    return StackedField(**own, other=other, share=share, overruled=overruled, gate=gate, views=views)


def average(tuned: AdaptedField, before: AdaptedField, share: float) -> AdaptedField:
    """A field after gradient steps with the one before them as one: it has the mean of the pictures of both.

    Steps on few views change what no view shows, too, partly for the worse. Their errors there are others than those
    of the field before them, so that a mean has less of them (docs/adaptation.md).

    Args:
        tuned: the field after the steps, whose densities are those of the result.
        before: the field before them.
        share: of the latter.
    """
    own = {each.name: getattr(tuned, each.name) for each in fields(tuned)}
    return AveragedField(**own, other=before, share=share)


@torch.no_grad()
def stacked_field(network: HyperPlanesNetwork, context: SupportContext, weights: Parameters) -> AdaptedField:
    """The field of given weights, stacked with the visual hull where the model is configured so.

    The share of the hull is that of the object's own update (`hull_share`), whatever the weights are, or the one that
    the model is configured with. From FEWEST views on the model's gating network, where it has one, makes a share of
    every pixel of that.

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
    gate = network.gate if len(context.views) >= FEWEST else None
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

    The hull is mixed in by the model's gating network, where it has one, with MANY_VIEWS given views or more, their
    reflections not counted. The network makes a share of every pixel, as where held-out views give the hull none. No
    view is held out: gradient steps learn from all of them. Where pictures are corrected (`residuals.are_corrected`)
    there is no hull in them: it brings nothing beside that (docs/image-based-measurements.md), and takes time.

    Args:
        network: the model.
        context: the object.
        weights: of the field.
        before: the weights before the steps, where their field is in the pictures.
        share: of that.
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
    """The share of `HullBlend` in the pictures of an object, by which views that are held out are shown best.

    What was learned may not fit an object of another kind, and where it does fit, the errors of both are different
    ones, so that a mean has less of them. The squared error of pixels of held-out views decides.

    Args:
        trial: with views held out (`held_out.hold_out`).

    Returns:
        The share, in [0, 1]: the best one (`best_share`) to the power of CAUTION. It is 0 where that lowers the squared
        error by less than MARGIN, and without a trial.
    """
    if trial is None:
        return 0.0
    without, hull = (trial.pixels.errors(each) for each in (trial.learned, hull_field(trial.context)))
    share = best_share(without, hull) ** CAUTION
    mixed = torch.lerp(without, hull, share)
    return share if float(mixed.square().sum()) < (1 - MARGIN) * float(without.square().sum()) else 0.0


def hull_field(context: SupportContext) -> AdaptedField:
    """What `HullBlend` makes of an object.

    Args:
        context: of a field that takes any number of views.
    """
    assert isinstance(context.planes, VisibilityPlanes)
    return HullBlend().adapt_to(context.planes)


def best_share(one: Float[Tensor, "pixel 3"], other: Float[Tensor, "pixel 3"]) -> float:
    """The share of the other in the mean of two predictions by which its squared error is least.

    >>> best_share(torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]))
    0.5

    Args:
        one: errors of a prediction.
        other: errors of another one.

    Returns:
        The minimum of a quadratic function, in [0, 1]; 0 where both predictions are the same.
    """
    between = other - one
    return float((-(one * between).sum() / between.square().sum().clamp_min(1e-12)).clamp(0, 1))
