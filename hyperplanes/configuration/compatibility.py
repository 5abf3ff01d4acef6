"""Compatibility rules between settings of different parts of a model."""

from __future__ import annotations

from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.fields import Target, find_targets
from hyperplanes.hypernetwork import VolumeHyperNetworkConfig
from hyperplanes.utilities.messages.errors import did_you_mean

__all__ = ["VOLUME_CHANNELS", "check_fine_tuning", "check_model", "check_training"]

VOLUME_CHANNELS = 4
"""Channels of a volume that the volume loss compares: occupied share, and mean colour."""


def check_model(config: ModelConfig) -> type[Target]:
    """The target network of a model with compatible parts.

    Raises:
        ValueError: an unknown field, or incompatible parts; the message names the setting to change.
    """
    known = find_targets()
    if config.target not in known:
        raise ValueError(
            f"target: expected one of {sorted(known)}, got {config.target!r}{did_you_mean(config.target, known)}"
        )
    target = known[config.target]
    if not isinstance(config.network, target.config_type):
        expected, found = target.config_type.__name__, type(config.network).__name__
        raise ValueError(f"network: expected a {expected} for {config.target}, got a {found}")
    _check_hypernetwork(config, target)
    if config.learned_steps and not isinstance(config.hypernetwork, VolumeHyperNetworkConfig):
        raise ValueError(
            f"learned_steps: expected 0 without a hypernetwork of kind 'volume', got {config.learned_steps}"
        )
    if config.plane_dropout and (target.permutation_invariant or not target.reads_planes):
        raise ValueError(f"plane_dropout: expected a field with a fixed number of planes, got {config.target}")
    if config.learned_correction and not config.residuals:
        raise ValueError("learned_correction: expected residuals, which it is computed from, got none")
    for name in ("stacked", "hull_share", "gated", "average", "symmetric", "symmetry", "azimuth"):
        if getattr(config, name) and not target.permutation_invariant:
            raise ValueError(f"{name}: expected a field that takes any number of views, got {config.target}")
    return target


def _check_hypernetwork(config: ModelConfig, target: type[Target]) -> None:
    """The field must provide what a hypernetwork reads, in a number that both support."""
    hypernetwork = config.hypernetwork
    if isinstance(hypernetwork, VolumeHyperNetworkConfig):
        if target.volume_size is None:
            raise ValueError(
                f"hypernetwork.kind: expected one that reads images for {config.target}, which takes a fixed number "
                "of views, got 'volume'"
            )
        if not getattr(config.network, "grid", 0):
            raise ValueError("network.grid: expected features of a grid for hypernetwork.kind 'volume' to write, got 0")
        cells = target.volume_size[1]
        if (given := getattr(config.network, "cells", cells)) != cells:
            raise ValueError(f"network.cells: expected {cells} for hypernetwork.kind 'volume', got {given}")
        return
    reader = hypernetwork or config.autoencoder
    if reader is None:
        return
    if target.permutation_invariant:
        if hypernetwork is None or hypernetwork.join != "mean":
            found = "an autoencoder" if hypernetwork is None else repr(hypernetwork.join)
            raise ValueError(
                f"{config.target}: expected a hypernetwork of kind 'volume', or with join 'mean', which takes "
                f"HyperPlanes in any number and order, got {found}"
            )
    elif reader.views > config.network.planes:
        planes = config.network.planes
        kind = "autoencoder" if hypernetwork is None else "hypernetwork"
        raise ValueError(f"{kind}.views: expected at most as many as planes, {planes}, got {reader.views}")


def check_fine_tuning(settings: FineTuning, steps: Steps, views: int, config: ModelConfig, target: Target) -> None:
    """Refuse fine-tuning that is impossible for the model.

    Args:
        settings: of fine-tuning.
        steps: number of steps, or "auto".
        views: number of support views, without reflections.
        config: of the model.
        target: its network.

    Raises:
        ValueError: training the hypernetwork of a model without one, a negative number of steps, steps on a single view
            for a field that would learn to copy it, or averaging with pictures of partly random weights.
    """
    if settings.trainable == "hypernetwork" and config.hypernetwork is None and config.autoencoder is None:
        raise ValueError("fine_tune: expected a model with a hypernetwork, got one without")
    if settings.trainable == "hypernetwork" and settings.cells:
        raise ValueError(
            f"cells: expected None or 0 for a hypernetwork, whose grid has its cells, got {settings.cells}"
        )
    if steps != "auto" and steps < 0:
        raise ValueError(f"steps: expected 0 or more, or 'auto', got {steps}")
    if steps and views == 1 and target.permutation_invariant and settings.mask_views:
        raise ValueError(
            f"steps: expected 0 with a single view, whose colours {config.target} would learn to copy, got "
            f"{steps}; give 2 views or more"
        )
    if settings.average and (fresh := settings.fresh_share(views)) and config.hypernetwork is not None:
        raise ValueError(
            f"average: expected 0 with partly random initial weights (fresh {fresh:g}), got {settings.average:g}"
        )


def check_training(config: TrainingConfig, model: ModelConfig) -> None:
    """Refuse training that is impossible for the model.

    Raises:
        ValueError: numbers of views for a field with a fixed number, a single view per object for a field that takes
            any number, settings that a learned initialisation does not use, rotations without numbers of views, or the
            volume loss for a model without a volume or a grid.
    """
    if config.views and (not find_targets()[model.target].permutation_invariant or min(config.views) < 1):
        raise ValueError(
            "training.views: expected numbers of at least 1, for the field image_based, which takes any of them, "
            f"got {list(config.views)} for {model.target}"
        )
    if model.method == "sv_meta" and find_targets()[model.target].permutation_invariant:
        raise ValueError(
            f"sv_meta: expected a field with a fixed number of views, got {model.target}, which would learn to "
            "copy the colours of a single view"
        )
    for name in ("random_background", "empty_points", "antialias"):
        if getattr(config, name) and model.initialisation is not None:
            raise ValueError(
                f"training.{name}: expected {type(getattr(config, name))()} for {model.method}, whose steps on "
                f"an object are plain fine-tuning, got {getattr(config, name)}"
            )
    if model.plane_dropout and model.initialisation is not None:
        raise ValueError(
            f"model.plane_dropout: expected 0 for {model.method}, which masks no plane, got {model.plane_dropout}"
        )
    if config.rotations and not config.views:
        raise ValueError(f"training.rotations: expected 0 without training.views, got {config.rotations}")
    volume, grid = isinstance(model.hypernetwork, VolumeHyperNetworkConfig), getattr(model.network, "grid", 0)
    if config.volume_loss and not (volume and grid >= VOLUME_CHANNELS and config.views):
        raise ValueError(
            f"training.volume_loss: expected training.views, a hypernetwork of kind 'volume' and a grid of at "
            f"least {VOLUME_CHANNELS} features, got views {list(config.views)}, {'one' if volume else 'no'} such "
            f"hypernetwork and {grid} features"
        )
