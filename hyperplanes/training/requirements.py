"""What the parts of a training need of the model, and of each other."""

from __future__ import annotations

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.training.configuration import TrainingConfig
from hyperplanes.training.episodes.episode import VOLUME_CHANNELS

__all__ = ["check_requirements"]


def check_requirements(config: TrainingConfig, model: HyperPlanes) -> None:
    """Refuse a training that the model cannot have.

    Raises:
        ValueError: numbers of views for a field that knows them by their places, rotations without such numbers, or
            the volume loss for a model without a volume or a grid.
    """
    if config.views and (not model.any_order or min(config.views) < 1):
        raise ValueError(
            "training.views: expected numbers of at least 1, for the field image_based, which takes any of them, "
            f"got {list(config.views)} for {model.config.target}"
        )
    for name in ("random_background", "empty_points"):
        if getattr(config, name) and model.config.initialisation is not None:
            raise ValueError(
                f"training.{name}: expected {type(getattr(config, name))()} for {model.config.method}, whose steps on "
                f"an object are plain fine-tuning, got {getattr(config, name)}"
            )
    if config.rotations and not config.views:
        raise ValueError(f"training.rotations: expected 0 without training.views, got {config.rotations}")
    if config.volume_loss and not (
        model.reads_volume and getattr(model.config.network, "grid", 0) >= VOLUME_CHANNELS and config.views
    ):
        raise ValueError(
            f"training.volume_loss: expected training.views, a hypernetwork of kind 'volume' and a grid of at "
            f"least {VOLUME_CHANNELS} features, got another model or training"
        )
