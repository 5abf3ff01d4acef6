"""The network of HyperPlanes: theta, the hypernetwork that updates it, and the rig of views it was trained with."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch
from torch import Tensor, nn

from hyperplanes.adaptation.base import AdaptedField, hull
from hyperplanes.adaptation.context import SupportContext, live_pixels, observe
from hyperplanes.adaptation.correction_network import CorrectionNetwork
from hyperplanes.adaptation.gating import GatingNetwork
from hyperplanes.adaptation.symmetry.reflections import UNKNOWN_OPACITY, penalty_offsets, with_reflections
from hyperplanes.configuration.compatibility import check_model
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.fields import Target
from hyperplanes.fields.rig import Rig
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.symmetry.reflections import Symmetry
from hyperplanes.geometry.visibility.planes import VisibilityPlanes
from hyperplanes.hypernetwork import HyperNetwork, LearnedStep
from hyperplanes.hypernetwork.making import make_hypernetwork
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.machine.locks import ForkSafeLock
from hyperplanes.utilities.messages.arguments import checked
from hyperplanes.utilities.tensors.seeding import seeded
from hyperplanes.views import Views

__all__ = ["GRID_WEIGHT", "HyperPlanesNetwork", "in_use"]

GRID_WEIGHT = "fine.grid.weight"
"""The grid of features of a field, among its weights."""


class HyperPlanesNetwork(nn.Module):
    """Support views -> a support context -> an update of theta; weights -> a field.

    Args:
        config: the architecture.
        seed: of the weights; the global random state is not used.

    Raises:
        ValueError: incompatible parts (`configuration.compatibility`).
    """

    rig: Tensor

    def __init__(self, config: ModelConfig, seed: int = 0) -> None:
        super().__init__()
        make = check_model(config)
        self.config = config
        with seeded(seed):
            self.targets: dict[str, Target] = {"fine": make(config.network)}
            if config.coarse_network:
                self.targets["coarse"] = make(config.network)
            self.networks = nn.ModuleDict(self.targets)
            self.hypernetwork: HyperNetwork | None = None
            if (shape := config.hypernetwork or config.autoencoder) is not None:
                shapes = {name: value.shape for name, value in self.networks.named_parameters()}
                reading, volume = self.target.reading_layers, self.target.volume_size
                self.hypernetwork = make_hypernetwork(shape, shapes, reading, volume)
            self.targets_before = {name: make(config.network) for name in self.targets if config.average}
            self.networks_before = nn.ModuleDict(self.targets_before)
            self.gate = GatingNetwork() if config.gated else None
            self.learned_step: LearnedStep | None = None
            if config.learned_steps:
                assert self.target.volume_size is not None  # `check_model`
                self.learned_step = LearnedStep(self.target.volume_size[1], self.theta[GRID_WEIGHT].shape[0])
            self.corrector = CorrectionNetwork() if config.learned_correction else None
        self.register_buffer("rig", torch.zeros(self.target.rig_size, 3))

    @property
    def theta(self) -> Parameters:
        """The universal weights; the tensors are those of the module."""
        return Parameters.of(self.networks)

    @property
    def theta_before(self) -> Parameters | None:
        """The weights before the gradient steps that made theta, if `config.average` is not 0."""
        return Parameters.of(self.networks_before) if self.networks_before else None

    @property
    def target(self) -> Target:
        """The network of colours and densities; with a coarse network, the fine one."""
        return self.targets["fine"]

    @property
    def reads_volume(self) -> bool:
        """Whether it has a hypernetwork that reads a volume."""
        return self.hypernetwork is not None and self.hypernetwork.reads_volume

    @property
    def known_rig(self) -> Rig:
        """The rig of the training views; empty where neither the field nor a hypernetwork needs it."""
        asked = self.target.reads_planes or self.hypernetwork is not None
        return Rig(self.rig if asked else self.rig[:0], self.config.order)

    def set_rig(self, support: Views) -> None:
        """Store the camera directions of these support views as those of the planes, if the field has a rig.

        Raises:
            ValueError: fewer views than planes.
        """
        planes = len(self.known_rig)
        if len(support) < planes:
            raise ValueError(f"support: expected at least {planes} views, one a plane, got {len(support)}")
        self.rig[:planes].copy_(support.camera_directions[:planes])

    def arrange(self, support: Views) -> Views:
        """The support views as the field takes them: one a plane of the rig, or all as they are.

        Of more views than planes, the best matches are taken, each once. Of fewer, some views become several planes.
        With order "file" the views keep their order: the first ones, repeated from the first if they are too few.

        Raises:
            ValueError: no view, or a rig that has not been set.
        """
        if not len(support):
            raise ValueError("support: expected at least one view, got none")
        return self.target.arrange(support, self.known_rig)

    @checked
    def prepare(self, support: Views, *, carved: bool = True, symmetry: Symmetry | None = None) -> SupportContext:
        """Computes what depends on the support views but not on weights.

        Args:
            support: the views of one object, on any device and in any precision.
            symmetry: of the object, whose views are then followed by their reflections.
            carved: if False, a single occupied voxel replaces the hull, for callers that never query it. For a
                hypernetwork that reads the hull it is carved in any case.

        Raises:
            ValueError: a symmetry for a field that does not take any number of views.
        """
        if symmetry is not None and not self.target.permutation_invariant:
            raise ValueError(f"symmetry: expected None for {self.config.target}, which takes a fixed number of views")
        given, support = len(support), with_reflections(self.to_own(support), symmetry)
        views, device = self.arrange(support), self.rig.device

        # the visual hull of all views, not only of those that become planes
        if carved or self.reads_volume:
            occupancy = hull(support, self.target.hull_resolution(self.config.hull_resolution, support))
        else:
            occupancy = full(support.bounds, 1, device)

        # what the field looks colours up in; with fewer views than planes, each view is shown at one plane, if planes
        # were masked in training
        planes = self.target.planes_of(views, occupancy)
        if isinstance(planes, VisibilityPlanes) and symmetry is not None:
            planes = planes.with_penalty_offsets(penalty_offsets(given, symmetry))
        if self.config.plane_dropout and len(support) < len(views):
            planes = planes.mask_views(self.known_rig.repeated(support).to(device))

        # what the hypernetwork reads: a volume of all views, or images of some of them
        volume, chosen = None, torch.arange(0, device=device)
        if self.reads_volume:
            volume, chosen = self.target.volume_of(planes), torch.arange(len(views), device=device)
        elif (reader := self.hypernetwork) is not None:
            chosen = self.target.choose_hyperplanes(views, self.known_rig, reader.views, reader.choice)
        return SupportContext(views, planes, occupancy, chosen, volume, symmetry)

    def to_own(self, support: Views) -> Views:
        """The views with the device and dtype of the weights; ValueError for weights of less than single precision."""
        if self.rig.dtype.itemsize < 4:
            raise ValueError(
                f"model: expected weights of single or double precision, got {self.rig.dtype}; make them single with "
                "float(): what is faster in half precision is computed in it"
            )
        return support.to(self.rig.device, self.rig.dtype)

    def update(self, context: SupportContext) -> Parameters:
        """The update of theta, in one forward pass (HyperPlanes, Eq. 7); empty without a hypernetwork."""
        return self.updates([context])[0]

    def updates(self, contexts: Sequence[SupportContext], *, mixed_precision: bool = False) -> list[Parameters]:
        """As `update`, of several objects in one batch.

        Args:
            contexts: of the objects.
            mixed_precision: compute the convolutions and matrix products of a single-precision hypernetwork in bfloat16
                (`torch.autocast`). Its weights and the updates keep their precision.
        """
        if self.hypernetwork is None:
            return [Parameters() for _ in contexts]
        observed = observe(contexts, self.hypernetwork.resolution)
        if not mixed_precision:
            return self.hypernetwork(observed, self.theta)
        theta = self.theta
        with torch.autocast(self.rig.device.type, torch.bfloat16, cache_enabled=False):  # threads would share the cache
            found = self.hypernetwork(observed, theta)
        return [Parameters((name, value.to(theta[name].dtype)) for name, value in update.items()) for update in found]

    def field(self, context: SupportContext, parameters: Parameters) -> AdaptedField:
        """The field of given weights on the planes of an object (HyperPlanes, Eq. 5)."""
        bound = {
            name: network.bind(parameters.under(name), context.planes, context.occupancy.bounds)
            for name, network in self.targets.items()
        }
        densities = tuple(field.density for field in bound.values())
        return AdaptedField(
            bound["fine"],
            context.occupancy,
            self.config.sampling,
            bound.get("coarse"),
            densities,
            symmetry=context.symmetry,
        )

    def finer(self, weights: Parameters, cells: int) -> Parameters:
        """Weights of nearly the same fields with more capacity for detail (`Target.finer`)."""
        result = Parameters(weights)
        for name, network in self.targets.items():
            found = network.finer(weights.under(name), cells)
            result.update({f"{name}.{key}": value for key, value in found.items()})
        return result

    def rendering_field(self, context: SupportContext, parameters: Parameters) -> AdaptedField:
        """As `field`, but a field that uses visibility takes colours from views that see the surface of its density.

        The visual hull has no hollows: with it, the seat of an armchair gets colours of views that do not see it.
        Training and gradient steps use the hull.
        """
        by_hull = self.field(context, parameters)
        if not self.target.permutation_invariant:
            return by_hull
        with torch.no_grad():
            voxels = by_hull.refined_occupancy
            planes = self.target.with_surface(context.planes, voxels.solid())
        return replace(self.field(replace(context, planes=planes), parameters), refined=voxels)

    def adapted_weights(self, context: SupportContext) -> Parameters:
        """Theta + delta in evaluation mode, whatever the mode of the model, as `updated_by` returns them."""
        with torch.no_grad(), in_use(self):
            return self.updated_by(self.update(context))

    @torch.no_grad()
    def updated_by(self, update: Parameters) -> Parameters:
        """Theta + an update, without gradients; later training does not change them."""
        found = self.theta + update
        return Parameters((name, value if name in update else value.clone()) for name, value in found.items())

    def live_pixels_of(self, context: SupportContext, views: Views) -> Tensor | None:
        """Flat indices of the pixels of views whose rays meet the hull; None if rays are drawn from all pixels.

        Pixels in which a reflection is known to be wrong are left out.
        """
        if not self.config.sampling.needs_occupancy:
            return None
        pixels = live_pixels(context.occupancy, views)
        if context.symmetry is None or views.masks is None:
            return pixels
        return pixels[views.masks.flatten()[pixels] != views.masks.new_tensor(UNKNOWN_OPACITY)]


_in_use: dict[nn.Module, tuple[int, bool]] = {}
"""How many users each module has, and whether it was in training mode before."""

_counting = ForkSafeLock()


@contextmanager
def in_use(module: nn.Module) -> Generator[None]:
    """Evaluation mode for the module while the context lasts.

    Several threads may use it, or models that share parts of it, at once: the earlier mode of each part is restored
    when its last user has ended.
    """
    parts = list(module.modules())
    with _counting:
        for part in parts:
            users, before = _in_use.get(part, (0, part.training))
            _in_use[part] = users + 1, before
            part.training = False
    try:
        yield
    finally:
        with _counting:
            for part in parts:
                users, before = _in_use.pop(part)
                if users > 1:
                    _in_use[part] = users - 1, before
                else:
                    part.training = before
