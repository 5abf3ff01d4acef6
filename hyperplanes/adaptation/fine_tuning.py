"""Fine-tuning: gradient steps from theta + delta on the support views of one object (HyperPlanes, section 3)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.canonical_frame import to_canonical_frame
from hyperplanes.adaptation.context import SupportContext, observe, trained_on
from hyperplanes.adaptation.descent import Descent, split_holdout
from hyperplanes.adaptation.learned_steps import updated_weights
from hyperplanes.adaptation.network import HyperPlanesNetwork
from hyperplanes.adaptation.stacking import stacked_field, tuned_field
from hyperplanes.configuration.compatibility import check_fine_tuning
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.parameters import Parameters
from hyperplanes.views import Views

__all__ = [
    "NoProgressError",
    "average_of",
    "fine_tune",
    "fine_tune_to",
    "made_anyway",
    "make_descent",
    "one_step",
]

Made = TypeVar("Made")

NEARLY = 0.99  # of the error of an empty picture, which a field that has lost everything may miss by rounding


class NoProgressError(ValueError):
    """Gradient steps that end neither below the error before them nor below that of an empty picture.

    Attributes:
        field: what they made all the same; None where its error is no number.
    """

    def __init__(self, message: str, field: AdaptedField | None = None) -> None:
        super().__init__(message)
        self.field = field


def made_anyway(make: Callable[[], Made]) -> Made | AdaptedField:
    """What gradient steps made, even where they lowered nothing.

    Args:
        make: takes them.

    Raises:
        NoProgressError: they ended in no numbers.
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
        on_trial: likewise, while "auto" finds how many they are to be.
    """
    support, settings = network.to_own(support), settings or FineTuning()
    check_fine_tuning(settings, steps, len(support), network.config, network.target)
    if steps != "auto":
        return _fine_tune_in_frame(network, support, steps, settings, None, on_step)

    # how many steps show some of the views best that the others were fine-tuned without, from as many random weights
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

    # as many steps on all of them, by the same schedule
    return _fine_tune_in_frame(network, support, stop, settings, settings.max_steps, on_step)


def _fine_tune_in_frame(
    network: HyperPlanesNetwork,
    support: Views,
    steps: int,
    settings: FineTuning,
    schedule: int | None,
    on_step: Callable[[int], None] | None,
) -> AdaptedField:
    """As `fine_tune_to`, of an object that is rotated into its canonical frame for that."""
    placed = to_canonical_frame(network, support)
    context = placed.context(network)
    views = trained_on(context, placed.views)
    try:
        tuned = fine_tune_to(network, context, steps, settings, views=views, schedule=schedule, on_step=on_step)
    except NoProgressError as error:
        error.field = None if error.field is None else placed.in_scene(error.field)
        raise
    return placed.in_scene(tuned)


@torch.no_grad()
def one_step(network: HyperPlanesNetwork, support: Views) -> AdaptedField:
    """As `HyperPlanes.adapt`.

    Args:
        network: the model.
        support: the views of the object.
    """
    placed = to_canonical_frame(network, support)
    context = placed.context(network)
    return placed.in_scene(stacked_field(network, context, updated_weights(network, context)))


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
    """As `fine_tune`, of an object that is prepared.

    Args:
        network: the model.
        context: the object.
        steps: taken.
        settings: as in `fine_tune`.
        views: where rays come from; those of the planes where absent.
        schedule: the number of steps in which the rates fall; `steps` where absent.
        on_step: as in `fine_tune`.

    Raises:
        NoProgressError: the steps lowered nothing: wild rates end in pictures that are empty, or in no numbers.
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
    if not after < max(before, empty * NEARLY):
        raise NoProgressError(
            f"fine-tuning: expected {steps} steps to lower the squared error, {before:.3g}, got {after:.3g}, where an "
            f"empty picture has {empty:.3g}; lower learning_rate and muon_learning_rate, or take the field of 0 steps",
            made if math.isfinite(after) else None,
        )
    return made


def average_of(
    network: HyperPlanesNetwork, context: SupportContext, settings: FineTuning, descent: Descent
) -> tuple[Parameters | None, float]:
    """The weights of the field that pictures after gradient steps are averaged with, and its share in them.

    They are those that the steps begin with, or, where the model is what others made of one object, those before these.

    Args:
        network: the model.
        context: the object.
        settings: as in `fine_tune`.
        descent: before its first step.

    Returns:
        None and 0 where pictures are those after the steps alone.
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
    """Gradient descent on rays of an object's views: what fine-tuning and learned initialisations do.

    Args:
        network: the model.
        context: the object.
        settings: what is optimised, rates, rays and seed.
        views: where rays come from; those of the planes where absent.
        start: the weights to begin with; those of `adapt` where absent.
    """
    views, any_views = context.views if views is None else views, network.target.permutation_invariant
    settings = settings.for_views(len(context.given), any_views)
    if start is not None:  # which keeps its shape
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
    """What a descent optimises, in place, and the weights of the field that it makes of that."""
    if settings.trainable == "hypernetwork" and network.hypernetwork is not None:
        observed, theta = observe([context], network.hypernetwork.resolution), network.theta.detach()
        tuned = copy.deepcopy(network.hypernetwork).eval().requires_grad_(True)
        return list(tuned.parameters()), lambda: theta + tuned(observed, theta)[0]
    if start is None:
        # weights that are partly random are so without learned steps
        own = network.adapted_weights(context) if settings.fresh else updated_weights(network, context)
        start = network.finer(_refreshed(network, own, settings), settings.cells or 0)
    trainable = Parameters((name, value.detach().clone().requires_grad_(True)) for name, value in start.items())
    return list(trainable.values()), lambda: trainable if torch.is_grad_enabled() else trainable.detach()


def _refreshed(network: HyperPlanesNetwork, weights: Parameters, settings: FineTuning) -> Parameters:
    """Trained weights interpolated with random ones, where a hypernetwork writes a grid; others as they are."""
    share = settings.fresh
    if not share or not network.reads_volume:
        return weights
    made = HyperPlanesNetwork(network.config.target_alone(), settings.seed)
    random = made.to(network.rig.device, network.rig.dtype).theta.detach()
    return Parameters((name, torch.lerp(value, random[name], share)) for name, value in weights.items())
