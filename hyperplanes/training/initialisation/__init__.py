"""Training of learned initialisations: Reptile and MAML on objects, and random weights matched to Reptile's."""

from __future__ import annotations

from pathlib import Path

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.training.initialisation.maml import MAML
from hyperplanes.training.initialisation.matching import Matching
from hyperplanes.training.initialisation.reptile import Reptile
from hyperplanes.training.objective import Objective
from hyperplanes.training.trainer import Trainer
from hyperplanes.views import Tasks

__all__ = ["MAML", "Matching", "Reptile", "initialisation_objective", "initialisation_trainer"]


def initialisation_objective(
    model: HyperPlanes, config: TrainingConfig, reference: HyperPlanes | None = None
) -> Objective:
    """The objective of the training of a model with an `InitialisationConfig`.

    Args:
        model: the model that is trained.
        config: the configuration of the training.
        reference: for "mv_matched", the initialisation to match.

    Raises:
        ValueError: "mv_matched" without a reference.
    """
    assert model.config.initialisation is not None
    method = model.config.initialisation.method
    if method == "mv_matched":
        if reference is None:
            raise ValueError("mv_matched: expected a checkpoint of mv_meta to match, got none; see --checkpoint")
        return Matching(model, config, reference)
    return (Reptile if method in ("mv_meta", "sv_meta") else MAML)(model, config)


def initialisation_trainer(
    model: HyperPlanes, data: Tasks, config: TrainingConfig, folder: Path | None, reference: HyperPlanes | None = None
) -> Trainer:
    """The trainer of a model with an `InitialisationConfig`.

    The arguments are those of `Trainer` and of `initialisation_objective`.
    """
    return Trainer(model, data, config, folder, initialisation_objective(model, config, reference))
