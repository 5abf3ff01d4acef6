"""Fine-tuning: gradient steps from theta + delta on the support views of one object (HyperPlanes, section 3)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from hyperplanes.adaptation.alignment.canonical_frame import to_canonical_frame
from hyperplanes.adaptation.base import AdaptedField, check_masks
from hyperplanes.adaptation.context import SupportContext, observe, trained_on
from hyperplanes.adaptation.correction.residuals import corrected_field
from hyperplanes.adaptation.correction.stacking import stacked_field, tuned_field
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.optimisation.descent import Descent, split_holdout
from hyperplanes.adaptation.optimisation.learned_steps import updated_weights
from hyperplanes.configuration.compatibility import check_fine_tuning
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.parameters import Parameters
from hyperplanes.views import Views

__all__ = [
    "NoProgressError",
    "average_of",
    "fine_tune",
    "fine_tune_to",
    "ignoring_no_progress",
    "make_descent",
]

Made = TypeVar("Made")

# of the error of an empty picture, which rounding may change for a field that has lost everything
EMPTY_ERROR_FRACTION = 0.99


class NoProgressError(ValueError):
    """Gradient steps whose final error is below neither the initial one nor that of an empty picture.

    Attributes:
        field: the field after the steps; None if its error is not finite.
    """

    def __init__(self, message: str, field: AdaptedField | None = None) -> None:
        super().__init__(message)
        self.field = field


def ignoring_no_progress(make: Callable[[], Made]) -> Made | AdaptedField:
    """The field after gradient steps, even if they made no progress.

    Args:
        make: takes the steps.

    Raises:
        NoProgressError: their error is not finite.
    """
    try:
        return make()
    except NoProgressError as error:
        if error.field is None:
            raise
        return error.field


def fine_tune(
    network: HyperPlanesNetwork,
    support: Views,
    steps: Steps,
    settings: FineTuning | None = None,
    *,
    on_step: Callable[[int], None] | None = None,
    on_trial: Callable[[int], None] | None = None,
) -> AdaptedField:
    """As `HyperPlanes.fine_tune`.

    Args:
        network: the model.
        support: the views of the object.
        steps: gradient steps, or "auto".
        settings: what is optimised, rates, rays and seed.
        on_step: called with the number of steps done.
        on_trial: the same for the trial steps of "auto".
    """
    support, settings = network.to_own(support), settings or FineTuning()
    check_fine_tuning(settings, steps, len(support), network.config, network.target)
    if steps != "auto":
        return _fine_tune_in_frame(network, support, steps, settings, None, on_step)

    # the number of steps that is best for held-out views, with the share of random weights for all views
    check_masks(support)
    settings = settings.for_views(len(support), network.target.permutation_invariant)
    shown, holdout = split_holdout(support, settings)
    placed = to_canonical_frame(network, shown)
    holdout = placed.rotation.views(holdout)
    context = placed.context(network)
    trial = make_descent(network, context, settings, trained_on(context, placed.views))
    pixels = network.live_pixels_of(context, holdout)
    unchanged = network.field(context, updated_weights(network, context))
    before, share = average_of(network, context, settings, trial)
    beside = None if before is None else network.field(context, before)
    stop = trial.best_stop(holdout, unchanged=unchanged, beside=beside, share=share, pixels=pixels, on_step=on_trial)

    # as many steps on all views, with the same schedule
    return _fine_tune_in_frame(network, support, stop, settings, settings.max_steps, on_step)


def _fine_tune_in_frame(
    network: HyperPlanesNetwork,
    support: Views,
    steps: int,
    settings: FineTuning,
    schedule: int | None,
    on_step: Callable[[int], None] | None,
) -> AdaptedField:
    """As `fine_tune_to`, with the object rotated into its canonical frame, and with residual correction."""
    placed = to_canonical_frame(network, support)
    context = placed.context(network)
    views = trained_on(context, placed.views)

    def finished(field: AdaptedField) -> AdaptedField:
        return corrected_field(network, placed.in_scene(replace(field, fine_tuned=steps > 0)), support)

    try:
        tuned = fine_tune_to(network, context, steps, settings, views=views, schedule=schedule, on_step=on_step)
    except NoProgressError as error:
        error.field = None if error.field is None else finished(error.field)
        raise
    return finished(tuned)


def fine_tune_to(
    network: HyperPlanesNetwork,
    context: SupportContext,
    steps: int,
    settings: FineTuning,
    *,
    views: Views | None = None,
    schedule: int | None = None,
    on_step: Callable[[int], None] | None = None,
) -> AdaptedField:
    """As `fine_tune`, of a prepared object.

    Args:
        network: the model.
        context: the object.
        steps: number of steps.
        settings: as in `fine_tune`.
        views: the views that rays are drawn from; by default those of the context.
        schedule: the number of steps over which the rates fall; by default `steps`.
        on_step: as in `fine_tune`.

    Raises:
        NoProgressError: the steps did not lower the error: too high rates end in empty pictures, or in NaN.
    """
    check_fine_tuning(settings, steps, len(context.given), network.config, network.target)
    if not steps:
        if on_step is not None:
            on_step(0)
        with torch.no_grad():
            return stacked_field(network, context, updated_weights(network, context))
    descent = make_descent(network, context, settings, views)
    average = average_of(network, context, settings, descent)
    before, _ = descent.errors()
    for done in descent.run(steps if schedule is None else schedule):
        if on_step is not None:
            on_step(done)
        if done == steps:
            break
    after, empty = descent.errors()
    with torch.no_grad():
        made = tuned_field(network, context, descent.weights(), *average)
    if not after < max(before, empty * EMPTY_ERROR_FRACTION):
        raise NoProgressError(
            f"fine-tuning: expected {steps} steps to lower the squared error, {before:.3g}, got {after:.3g}, where an "
            f"empty picture has {empty:.3g}; lower learning_rate and muon_learning_rate, or take the field of 0 steps",
            made if math.isfinite(after) else None,
        )
    return made


def average_of(
    network: HyperPlanesNetwork, context: SupportContext, settings: FineTuning, descent: Descent
) -> tuple[Parameters | None, float]:
    """The weights of the field that pictures after gradient steps are averaged with, and its share.

    They are the initial weights of the steps or, if the model was made by earlier steps on one object, of those.

    Args:
        network: the model.
        context: the object.
        settings: as in `fine_tune`.
        descent: before its first step.

    Returns:
        None and 0 if pictures are not averaged.
    """
    if network.theta_before is not None:
        return network.theta_before, network.config.average
    share = settings.average_share(len(context.given))
    if not share or not network.reads_volume:
        return None, 0.0
    return Parameters((name, value.detach().clone()) for name, value in descent.weights().items()), share


def make_descent(
    network: HyperPlanesNetwork,
    context: SupportContext,
    settings: FineTuning,
    views: Views | None = None,
    start: Parameters | None = None,
) -> Descent:
    """Gradient descent on rays of the views of an object, for fine-tuning and learned initialisations.

    Args:
        network: the model.
        context: the object.
        settings: what is optimised, rates, rays and seed.
        views: the views that rays are drawn from; by default those of the context.
        start: the initial weights; by default those of `adapt`.
    """
    views, any_views = context.views if views is None else views, network.target.permutation_invariant
    settings = settings.for_views(len(context.given), any_views)
    if start is not None:  # the grid keeps its shape
        settings = replace(settings, cells=0)
    if settings.trainable == "weights":
        settings = settings.with_rates(network.target.fine_tuning_rates)
    tensors, weights = _variables(network, context, settings, start)

    def field(masked: Tensor | None) -> AdaptedField:
        return network.field(context if masked is None else context.mask_views(masked), weights())

    pixels = network.live_pixels_of(context, views)
    return Descent(field, tensors, weights, views, settings, pixels, masks_views=any_views)


def _variables(
    network: HyperPlanesNetwork, context: SupportContext, settings: FineTuning, start: Parameters | None
) -> tuple[list[Tensor], Callable[[], Parameters]]:
    """The tensors that a descent optimises in place, and a function that makes the weights of the field from them."""
    if settings.trainable == "hypernetwork" and network.hypernetwork is not None:
        observed, theta = observe([context], network.hypernetwork.resolution), network.theta.detach()
        tuned = copy.deepcopy(network.hypernetwork).eval().requires_grad_(True)
        return list(tuned.parameters()), lambda: theta + tuned(observed, theta)[0]
    if start is None:
        # no learned steps before weights are mixed with random ones
        own = network.adapted_weights(context) if settings.fresh else updated_weights(network, context)
        start = network.finer(_refreshed(network, own, settings), settings.cells or 0)
    trainable = Parameters((name, value.detach().clone().requires_grad_(True)) for name, value in start.items())
    return list(trainable.values()), lambda: trainable if torch.is_grad_enabled() else trainable.detach()


def _refreshed(network: HyperPlanesNetwork, weights: Parameters, settings: FineTuning) -> Parameters:
    """Trained weights interpolated with random ones if a hypernetwork writes a grid; otherwise unchanged."""
    share = settings.fresh
    if not share or not network.reads_volume:
        return weights
    made = HyperPlanesNetwork(network.config.target_alone(), settings.seed)
    random = made.to(network.rig.device, network.rig.dtype).theta.detach()
    return Parameters((name, torch.lerp(value, random[name], share)) for name, value in weights.items())
