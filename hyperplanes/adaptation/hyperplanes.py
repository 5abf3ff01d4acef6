"""HyperPlanes: a target network, and the hypernetwork that writes its update from a few support views."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.adaptation.checkpoints import read_checkpoint, write_checkpoint
from hyperplanes.adaptation.context import SupportContext, arrange, live_pixels, observe, prepare_context
from hyperplanes.adaptation.descent import Descent, Variables, split_holdout
from hyperplanes.adaptation.hub import upload_checkpoint
from hyperplanes.adaptation.judging import judge_strength
from hyperplanes.configuration.compatibility import check_fine_tuning, check_model
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.fields import Target
from hyperplanes.fields.rig import Rig, standpoints
from hyperplanes.hypernetwork import HyperNetwork
from hyperplanes.hypernetwork.making import make_hypernetwork
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.arguments import checked
from hyperplanes.views import Views

__all__ = ["HyperPlanes", "ModelConfig"]


class HyperPlanes(nn.Module):
    """theta, the hypernetwork that updates it, and the rig of support views it was trained with.

    Without a hypernetwork the same weights serve every object: the plain target network that the paper compares with.
    Views are taken to where the weights are.

    Args:
        config: what it is made of.
        seed: of the weights; the global random state is left alone.

    Raises:
        ValueError: parts that do not go together (`configuration.compatibility`).
    """

    rig: Tensor

    def __init__(self, config: ModelConfig, seed: int = 0) -> None:
        super().__init__()
        make = check_model(config)
        self.config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.targets: dict[str, Target] = {"fine": make(config.network)}
            if config.coarse_network:
                self.targets["coarse"] = make(config.network)
            self.networks = nn.ModuleDict(self.targets)
            self.hypernetwork: HyperNetwork | None = None
            if (shape := config.hypernetwork or config.autoencoder) is not None:
                shapes = {name: value.shape for name, value in self.networks.named_parameters()}
                reading, volume = self.target.reading_layers, self.target.volume_size
                self.hypernetwork = make_hypernetwork(shape, shapes, reading, volume)
        self.register_buffer("rig", torch.zeros(self.target.rig_size, 3))

    @property
    def target(self) -> Target:
        """The network that colours and densities come from."""
        return self.targets["fine"]

    @property
    def theta(self) -> Parameters:
        """The universal weights, shared with the module."""
        return Parameters.of(self.networks)

    @property
    def any_order(self) -> bool:
        """Whether it takes any number of views in any order."""
        return self.target.permutation_invariant

    @property
    def reads_volume(self) -> bool:
        """Whether its hypernetwork reads what all views show on a grid."""
        return self.hypernetwork is not None and self.hypernetwork.reads_volume

    @property
    def known_rig(self) -> Rig:
        """Where the views of the training stood, and how others are matched to them."""
        return Rig(self.rig, self.config.order)

    def set_rig(self, support: Views) -> None:
        """Take the standpoints of these support views as the order of the planes; some fields have none.

        Raises:
            ValueError: fewer views than planes.
        """
        if len(support) < len(self.rig):
            raise ValueError(f"support: expected at least {len(self.rig)} views, one a plane, got {len(support)}")
        self.rig.copy_(standpoints(support)[: len(self.rig)])

    def arrange(self, support: Views) -> Views:
        """The support views as the field takes them: one a plane of the rig, or all as they are.

        More views than planes: the best matching ones, none twice. Fewer: some stand for several planes. With order
        "file" the views stay in their order: the first ones, and again from the first where there are too few.
        No view, or a rig that was never set, is a ValueError.
        """
        return arrange(support, self.target, self.known_rig)

    @checked
    def prepare(self, support: Views, *, carved: bool = True) -> SupportContext:
        """All that depends on the support views and not on weights.

        Args:
            support: the views of one object, on any device and in any precision.
            carved: without, one voxel that may hold anything stands for the hull, for who never asks it. A hypernetwork
                that reads the hull has it carved in any case.
        """
        return prepare_context(
            self._to_own(support),
            self.target,
            self.known_rig,
            self.hypernetwork,
            self.config.hull_resolution,
            carved=carved,
            masks_repeated=self.config.plane_dropout > 0,
        )

    def _to_own(self, support: Views) -> Views:
        """The views where the weights are, in their precision or at least single."""
        return support.to(self.rig.device, torch.promote_types(self.rig.dtype, torch.float32))

    def update(self, context: SupportContext) -> Parameters:
        """The update of theta, in one forward pass (HyperPlanes, Eq. 7); empty without a hypernetwork."""
        return self.updates([context])[0]

    def updates(self, contexts: Sequence[SupportContext]) -> list[Parameters]:
        """The updates of several objects, which are read in one batch; as `update`."""
        if self.hypernetwork is None:
            return [Parameters() for _ in contexts]
        return self.hypernetwork(observe(contexts, self.hypernetwork.resolution), self.theta)

    def field(self, context: SupportContext, parameters: Parameters) -> AdaptedField:
        """The field of given weights on the planes of an object (HyperPlanes, Eq. 5)."""
        bound = {
            name: network.bind(parameters.under(name), context.planes, context.occupancy.bounds)
            for name, network in self.targets.items()
        }
        densities = tuple(field.density for field in bound.values())
        return AdaptedField(bound["fine"], context.occupancy, self.config.sampling, bound.get("coarse"), densities)

    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The field of one object in a single step: theta + delta (HyperPlanes, Eq. 6).

        Where `config.judged` says so, two of the views decide how much of what was learned counts.
        """
        return self.adapt_to(self.prepare(support))

    @torch.no_grad()
    def adapt_to(self, context: SupportContext) -> AdaptedField:
        """As `adapt`, of an object that is prepared."""
        weights = self._adapted_weights(context)
        if self.config.judged:
            with _in_use(self):
                weights = self.attenuated(weights, judge_strength(self, context.views))
        return self.rendering_field(context, weights)

    def attenuated(self, parameters: Parameters, strength: float) -> Parameters:
        """Weights of a field between that of given ones and one of which nothing is learned (`Target.attenuated`).

        Args:
            parameters: theta + delta.
            strength: 1 leaves them as they are.
        """
        parts = {name: network.attenuated(parameters.under(name), strength) for name, network in self.targets.items()}
        return Parameters((f"{name}.{key}", value) for name, part in parts.items() for key, value in part.items())

    def rendering_field(self, context: SupportContext, parameters: Parameters) -> AdaptedField:
        """As `field`, after a second pass where the model takes two."""
        return self.field(self._second_pass(context, parameters), parameters)

    @torch.no_grad()
    def _adapted_weights(self, context: SupportContext) -> Parameters:
        """Theta + delta as they are in use, whatever mode the model is in."""
        with _in_use(self):
            return self.theta + self.update(context)

    @torch.no_grad()
    def _second_pass(self, context: SupportContext, weights: Parameters) -> SupportContext:
        """The planes with the surface that these weights show to each of them, where the model takes two passes."""
        if not self.config.second_pass:
            return context
        seen = self.field(context, weights).render(context.views.cameras)
        return replace(context, planes=self.target.with_surface(context.planes, seen.depth[:, 0], seen.opacity[:, 0]))

    @checked
    def fine_tune(
        self,
        support: Views,
        steps: Steps,
        settings: FineTuning | None = None,
        *,
        on_step: Callable[[int], None] | None = None,
        on_trial: Callable[[int], None] | None = None,
    ) -> AdaptedField:
        """The field of one object after gradient steps on its support views; the model itself stays as it is.

        It begins at theta + delta, of which `settings.fresh` is replaced by random weights. Either these weights
        themselves are optimised, or, as in the paper, a copy of the hypernetwork while theta is frozen (HyperPlanes,
        section 3, fine-tuning). No step is the field of `adapt`.

        Args:
            support: the views of the object.
            steps: gradient steps on rays of the support views, or "auto": as many, up to `settings.max_steps`, as show
                support views best that were held out for the purpose; 0 where every step made those worse.
            settings: what is optimised, rates, rays and seed.
            on_step: called with the number of steps done, before the first and after each.
            on_trial: likewise, while "auto" finds how many they are to be; there are up to `settings.max_steps`.

        Returns:
            The field. A model that takes a second pass takes it twice: the steps keep the surface of the weights that
            they begin with, and the field has that of its own. Steps that cannot be taken are a ValueError: those of a
            hypernetwork that the model has not, a negative number, "auto" with fewer than 3 views, or a single view of
            a field that takes any number of them, unless `settings.mask_views` is off.
        """
        support, settings = self._to_own(support), settings or FineTuning()
        check_fine_tuning(settings, steps, len(support), self.config, self.target)
        if steps != "auto":
            return self.fine_tune_to(self.prepare(support), steps, settings, views=support, on_step=on_step)

        # how many steps show some of the views best that the others were fine-tuned without
        shown, holdout = split_holdout(support, settings)
        context = self.prepare(shown)
        trial, _ = self.descent(context, settings, shown)
        stop = trial.best_stop(holdout, pixels=self._live_pixels(context, holdout), on_step=on_trial)

        # as many steps on all of them, by the same schedule
        context, schedule = self.prepare(support), settings.max_steps
        return self.fine_tune_to(context, stop, settings, views=support, schedule=schedule, on_step=on_step)

    def fine_tune_to(
        self,
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
            context: the object.
            steps: taken.
            settings: as in `fine_tune`.
            views: where rays come from; those of the planes where absent.
            schedule: the number of steps in which the rates fall; `steps` where absent.
            on_step: as in `fine_tune`.
        """
        check_fine_tuning(settings, steps, len(views or context.views), self.config, self.target)
        if not steps:
            if on_step is not None:
                on_step(0)
            return self.adapt_to(context)
        descent, variables = self.descent(context, settings, views)
        for done in descent.run(steps if schedule is None else schedule):
            if on_step is not None:
                on_step(done)
            if done == steps:
                break
        with torch.no_grad():
            return self.rendering_field(context, variables.weights())

    def descent(
        self,
        context: SupportContext,
        settings: FineTuning,
        views: Views | None = None,
        start: Parameters | None = None,
    ) -> tuple[Descent, Variables]:
        """Gradient descent on rays of an object's views: what fine-tuning and learned initialisations do.

        Args:
            context: the object.
            settings: what is optimised, rates, rays and seed.
            views: where rays come from; those of the planes where absent.
            start: the weights to begin with, and no second pass is taken; those of `adapt` where absent.
        """
        views = context.views if views is None else views
        if settings.trainable == "weights":
            settings = settings.with_rates(self.target.fine_tuning_rates)
        variables = self._variables(context, settings, start)
        shown = self._second_pass(context, variables.weights()) if start is None else context

        def field(masked: Tensor | None) -> AdaptedField:
            return self.field(shown if masked is None else shown.hiding(masked), variables.weights())

        pixels, masks_views = self._live_pixels(context, views), self.target.permutation_invariant
        return Descent(field, variables.tensors, views, settings, pixels, masks_views), variables

    def _variables(self, context: SupportContext, settings: FineTuning, start: Parameters | None) -> Variables:
        """What a descent optimises: weights, or a copy of the hypernetwork."""
        if settings.trainable == "hypernetwork" and self.hypernetwork is not None:
            observed, theta = observe([context], self.hypernetwork.resolution), self.theta.detach()
            return Variables.of_hypernetwork(self.hypernetwork, theta, lambda tuned: tuned(observed, theta)[0])
        if start is None:
            start = self._refreshed(self._adapted_weights(context), settings, len(context.views))
        return Variables.of_weights(start)

    def _refreshed(self, weights: Parameters, settings: FineTuning, views: int) -> Parameters:
        """Trained weights interpolated with random ones, where a hypernetwork writes a grid; others as they are."""
        share = settings.fresh_share(views)
        if not share or not self.reads_volume:
            return weights
        made = HyperPlanes(replace(self.config, hypernetwork=None, judged=False), settings.seed)
        random = made.to(self.rig.device, self.rig.dtype).theta.detach()
        return Parameters((name, torch.lerp(value, random[name], share)) for name, value in weights.items())

    def _live_pixels(self, context: SupportContext, views: Views) -> Tensor | None:
        """Flat indices of the pixels of views that look into the hull; None where all are drawn from."""
        return live_pixels(context.occupancy, views) if self.config.sampling.needs_occupancy else None

    def with_weights_of(self, adapted: AdaptedField) -> HyperPlanes:
        """The weights of one object as a model without a hypernetwork: its theta is theta + delta (HyperPlanes, Eq. 6).

        Args:
            adapted: what this model made of the object.

        Returns:
            A model that makes the same field of the same views, without looking at them twice. A field that is
            no network of this model is a ValueError.
        """
        result = HyperPlanes(replace(self.config, hypernetwork=None, autoencoder=None, initialisation=None))
        result.rig.copy_(self.rig)
        found = {"fine": adapted.field, "coarse": adapted.proposal}
        for name, network in result.targets.items():
            network.load_state_dict(network.parameters_of(found[name]))
        return result.eval()

    def save(self, folder: Path | str, dtype: torch.dtype | None = None) -> None:
        """Write model.json and model.safetensors.

        Args:
            folder: made where absent.
            dtype: of the weights in the file, such as float16, which halves it; their own where absent. Statistics stay
                as they are, and `from_pretrained` makes single precision of all.
        """
        weights = self.state_dict()
        if dtype is not None:
            weights |= {name: value.to(dtype) for name, value in self.named_parameters()}
        write_checkpoint(folder, self.config, weights)

    save_pretrained = save

    def push_to_hub(self, repository: str, *, private: bool = False, message: str = "Upload of a model") -> str:
        """Write the model to a repository of the Hugging Face hub, from which `from_pretrained` reads it.

        Args:
            repository: user/model; made where absent.
            private: for a repository that is made.
            message: of the commit.

        Returns:
            The address of the commit. A name of another form raises ValueError, a missing huggingface_hub RuntimeError.
        """
        return upload_checkpoint(self.save, repository, private=private, message=message)

    @classmethod
    def from_pretrained(cls, name: Path | str) -> HyperPlanes:
        """The model that `save` wrote.

        Args:
            name: its folder, the name of a model that comes with the package, or user/model on the Hugging Face hub
                where huggingface_hub is installed; a folder of that name goes first.

        Returns:
            The model, ready for use. What is missing, damaged or does not fit is a CheckpointError.
        """
        return read_checkpoint(name, cls)


@contextmanager
def _in_use(module: nn.Module) -> Generator[None]:
    """The module as it is used and not trained (batch statistics), and afterwards as it was."""
    before = {part: part.training for part in module.modules()}
    module.eval()
    try:
        yield
    finally:
        for part, training in before.items():
            part.training = training
