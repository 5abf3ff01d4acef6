"""Training of learned initialisations: Reptile and MAML on objects, and random weights matched to a learned one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.descent import ray_loss
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.initialisation import InitialisationConfig
from hyperplanes.data.support import SingleView
from hyperplanes.geometry.rays import Rays
from hyperplanes.parameters import Parameters
from hyperplanes.training.configuration import TrainingConfig
from hyperplanes.training.drawing import points_in
from hyperplanes.training.emptiness import thin_opacity
from hyperplanes.training.episodes import Episode
from hyperplanes.training.meta_gradients import maml_gradient, reptile_gradient
from hyperplanes.training.trainer import Trainer
from hyperplanes.views import Tasks

__all__ = ["MAMLTrainer", "MatchedTrainer", "ReptileTrainer", "initialisation_trainer"]


class _InitialisationTrainer(Trainer):
    """A training of weights that are judged after gradient steps on an object, as many as in training."""

    @property
    def initialisation(self) -> InitialisationConfig:
        """How the initialisation is learned."""
        assert self.model.config.initialisation is not None
        return self.model.config.initialisation

    def _adapted(self, episode: Episode) -> AdaptedField:
        settings = replace(self.initialisation.descent(self.config.rays), seed=self.config.seed)
        return self.model.fine_tune_to(episode.prepared, self.initialisation.inner_steps, settings)

    def _set_gradients(self, gradient: Parameters) -> None:
        for name, value in self.model.networks.named_parameters():
            value.grad = gradient[name]


class ReptileTrainer(_InitialisationTrainer):
    """theta minus what gradient descent on an object leads to is the gradient that Adam gets (Tancik et al. 2021).

    The rays of an object are those of its support views. The loss reported is that of query rays after the descent.
    """

    def __init__(self, model: HyperPlanes, data: Tasks, config: TrainingConfig, folder: Path | None = None) -> None:
        super().__init__(model, data, config, folder)
        if self.initialisation.method == "sv_meta":
            self.data = SingleView(self.data)

    @property
    def rays_per_step(self) -> int:
        """Rays of all inner steps on all objects."""
        return super().rays_per_step * self.initialisation.inner_steps

    def gradients(
        self, drawn: Sequence[str], episodes: Sequence[Episode], generators: Sequence[torch.Generator]
    ) -> float:
        """Reptile's gradient, averaged over the objects."""
        total, adapted = 0.0, []
        theta = self.model.theta.detach()
        for episode, generator in zip(episodes, generators, strict=True):
            settings = replace(self.initialisation.descent(self.config.rays), seed=_seed(generator))
            descent, variables = self.model.descent(episode.prepared, settings, start=theta)
            for _ in descent.run(self.initialisation.inner_steps):
                pass
            weights = variables.weights().detach()
            adapted.append(weights)
            field = self.model.field(episode.prepared, weights)
            with torch.no_grad():
                rays, truth = _draw(episode, field, self.config.rays, generator)
                total += float(ray_loss(field.trace(rays, generator), truth))
        self._set_gradients(reptile_gradient(theta, adapted))
        return total / len(episodes)


class MAMLTrainer(_InitialisationTrainer):
    """The loss of query rays after gradient steps on support rays, and its gradient through them (Finn et al. 2017).

    Raises:
        ValueError: a field of any order, which would learn to copy the views that support rays come from.
    """

    def __init__(self, model: HyperPlanes, data: Tasks, config: TrainingConfig, folder: Path | None = None) -> None:
        if model.target.permutation_invariant:
            raise ValueError(f"maml: expected a field that knows views by their places, got {model.config.target}")
        super().__init__(model, data, config, folder)

    @property
    def rays_per_step(self) -> int:
        """Rays of all inner steps and of the outer loss on all objects."""
        return super().rays_per_step * (self.initialisation.inner_steps + 1)

    def gradients(
        self, drawn: Sequence[str], episodes: Sequence[Episode], generators: Sequence[torch.Generator]
    ) -> float:
        """MAML's gradient, averaged over the objects."""
        total, mean = 0.0, Parameters()
        initialisation, theta = self.initialisation, self.model.theta.detach()
        for episode, generator in zip(episodes, generators, strict=True):
            field = self.model.field(episode.prepared, theta)
            batches = [
                _draw(episode, field, self.config.rays, generator, of_support=True)
                for _ in range(initialisation.inner_steps)
            ]
            losses = [
                self._loss(episode, rays, truth, _seed(generator))
                for rays, truth in [*batches, _draw(episode, field, self.config.rays, generator)]
            ]
            first_order = initialisation.method == "maml_first_order"
            gradient, loss = maml_gradient(
                theta, losses[:-1], losses[-1], initialisation.inner_rate, first_order=first_order
            )
            total += float(loss)
            parts = {name: value / len(episodes) for name, value in gradient.items()}
            mean = mean + parts if mean else Parameters(parts)
        self._set_gradients(mean)
        return total / len(episodes)

    def _loss(self, episode: Episode, rays: Rays, truth: Tensor, seed: int):  # noqa: ANN202
        def loss(parameters: Parameters) -> Tensor:
            generator = torch.Generator().manual_seed(seed)
            return ray_loss(self.model.field(episode.prepared, parameters).trace(rays, generator), truth)

        return loss


class MatchedTrainer(_InitialisationTrainer):
    """Random weights trained to give the colours and opacities of a learned initialisation at random points.

    "Matched" of Tancik et al. 2021: the same function in other weights. Opacity is that of a tenth of a radius.

    Args:
        model: trained in place.
        data: as in `Trainer`; of the objects only the planes are read, and of a NeRF nothing.
        config: as in `Trainer`; `rays` is the number of points.
        folder: as in `Trainer`.
        reference: the learned initialisation, of the same field.

    Raises:
        ValueError: a reference that is another field, or no learned initialisation.
    """

    def __init__(
        self, model: HyperPlanes, data: Tasks, config: TrainingConfig, folder: Path | None, reference: HyperPlanes
    ) -> None:
        super().__init__(model, data, config, folder)
        differing = reference.config.differences(replace(model.config, initialisation=reference.config.initialisation))
        if differing or reference.config.method != "mv_meta":
            what = f"other {', '.join(differing)}" if differing else f"a checkpoint of {reference.config.method}"
            raise ValueError(f"reference: expected mv_meta of the same field, which mv_matched is to match, got {what}")
        self.reference = reference.to(model.rig.device).eval().requires_grad_(False)
        model.rig.copy_(self.reference.rig)

    def gradients(
        self, drawn: Sequence[str], episodes: Sequence[Episode], generators: Sequence[torch.Generator]
    ) -> float:
        """The gradient of the squared differences of the outputs, averaged over the objects."""
        total = torch.zeros((), device=self.model.rig.device)
        for episode, generator in zip(episodes, generators, strict=True):
            bounds = episode.prepared.occupancy.bounds
            points = points_in(bounds, self.config.rays, generator).to(total)
            directions = torch.randn(self.config.rays, 3, generator=generator).to(total)
            directions = torch.nn.functional.normalize(directions, dim=1)
            made = [model.field(episode.prepared, model.theta) for model in (self.model, self.reference)]
            for mine, wanted in zip(*([each.field, each.proposal] for each in made), strict=True):
                if mine is None or wanted is None:
                    continue
                (colour, density), (true_colour, true_density) = mine(points, directions), wanted(points, directions)
                opacity, true_opacity = (thin_opacity(each, bounds) for each in (density, true_density))
                total = total + (colour - true_colour).square().mean() + (opacity - true_opacity).square().mean()
        (total / len(episodes)).backward()
        return float(total.detach()) / len(episodes)


def initialisation_trainer(
    model: HyperPlanes, data: Tasks, config: TrainingConfig, folder: Path | None, reference: HyperPlanes | None = None
) -> Trainer:
    """The training of a model with an `InitialisationConfig`.

    Args:
        model: trained in place.
        data: as in `Trainer`.
        config: as in `Trainer`.
        folder: as in `Trainer`.
        reference: for "mv_matched", the initialisation to match.

    Raises:
        ValueError: "mv_matched" without a reference.
    """
    assert model.config.initialisation is not None
    method = model.config.initialisation.method
    if method == "mv_matched":
        if reference is None:
            raise ValueError("mv_matched: expected a checkpoint of mv_meta to match, got none; see --checkpoint")
        return MatchedTrainer(model, data, config, folder, reference)
    return (ReptileTrainer if method in ("mv_meta", "sv_meta") else MAMLTrainer)(model, data, config, folder)


def _seed(generator: torch.Generator) -> int:
    return int(torch.randint(2**31, (), generator=generator))


def _draw(
    episode: Episode, field: AdaptedField, count: int, generator: torch.Generator, *, of_support: bool = False
) -> tuple[Rays, Tensor]:
    """Rays of the query views or of the planes of an object, and their colours."""
    views, live = (episode.prepared.views, episode.support_live) if of_support else (episode.query, episode.live)
    return views.sample_rays(count, generator=generator, among=live, span=field.sampling.span)
