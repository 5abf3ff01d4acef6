"""HyperPlanes: a target network, the hypernetwork that writes its update, and the checkpoint that holds them."""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hyperplanes.adaptation.base import AdaptedField, hull
from hyperplanes.checkpoints import CheckpointError, load_tensors, read_json, save_tensors, write_json
from hyperplanes.fields import TARGETS, Target, TargetConfig
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.hypernetwork.hypernetwork import HyperNetwork, HyperNetworkConfig
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.footprint import footprint
from hyperplanes.rendering.renderer import Hierarchical, Marched
from hyperplanes.views import Views

__all__ = ["HyperPlanes", "ModelConfig", "Prepared"]


@dataclass(frozen=True)
class ModelConfig:
    """What a model is made of; saved beside its weights.

    Attributes:
        target: which field: "point_multiplane", "multiplane" or "nerf".
        network: the shape of the target.
        hypernetwork: the shape of the hypernetwork, or None for one set of weights for all objects.
        coarse_network: whether a second network of the same shape proposes where to sample (NeRF's coarse network).
        sampling: how fields are rendered by default, in training too.
        hull_side: voxels an axis of the visual hull.
    """

    target: str = "point_multiplane"
    network: TargetConfig = field(default_factory=TargetConfig)
    hypernetwork: HyperNetworkConfig | None = field(default_factory=HyperNetworkConfig)
    coarse_network: bool = False
    sampling: Hierarchical | Marched = field(default_factory=Marched)
    hull_side: int = 64

    def as_json(self) -> dict[str, Any]:
        """A JSON object from which `of_json` makes the same configuration."""
        return {**asdict(self), "protocol": type(self.sampling).__name__.lower()}

    @classmethod
    def of_json(cls, value: dict[str, Any]) -> ModelConfig:
        """The configuration that `as_json` wrote.

        Raises:
            CheckpointError: an unknown or missing entry.
        """
        value = dict(value)
        try:
            protocol = {"hierarchical": Hierarchical, "marched": Marched}[value.pop("protocol")]
            hyper = value.pop("hypernetwork")
            if hyper is not None:
                hyper = HyperNetworkConfig(**{**hyper, "layers": tuple(hyper["layers"])})
            network, sampling = TargetConfig(**value.pop("network")), protocol(**value.pop("sampling"))
            return cls(network=network, sampling=sampling, hypernetwork=hyper, **value)
        except (KeyError, TypeError) as error:
            raise CheckpointError(
                f"configuration: expected the entries of this version's models, got a misfit ({error})"
            ) from None


@dataclass(frozen=True)
class Prepared:
    """The support side of one object, computed once.

    Attributes:
        views: the support views in the order of the model's rig, one a plane.
        planes: the same as ImagePlanes.
        occupancy: the visual hull of all support masks.
    """

    views: Views
    planes: ImagePlanes
    occupancy: Occupancy


class HyperPlanes(nn.Module):
    """theta, the hypernetwork that updates it, and the rig of support views it was trained with.

    Without a hypernetwork the same weights serve every object: the plain target network that the paper compares with.

    An MLP that concatenates what n planes say knows each plane by its place, so views of any other rig are matched to
    the one of the training (`arrange`).
    """

    rig: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        if config.target not in TARGETS:
            raise ValueError(f"target: expected one of {sorted(TARGETS)}, got {config.target!r}")
        self.config = config
        make = TARGETS[config.target]
        self.networks = nn.ModuleDict({"fine": make(config.network)})
        if config.coarse_network:
            self.networks["coarse"] = make(config.network)
        shapes = {name: value.shape for name, value in self.networks.named_parameters()}
        self.hypernetwork = HyperNetwork(config.hypernetwork, shapes) if config.hypernetwork else None
        self.register_buffer("rig", torch.zeros(config.network.planes, 3))

    @property
    def theta(self) -> Parameters:
        """The universal weights, shared with the module."""
        return Parameters.of(self.networks)

    def set_rig(self, support: Views) -> None:
        """Take the standpoints of these support views as the order of the planes.

        Raises:
            ValueError: fewer views than planes.
        """
        if len(support) < len(self.rig):
            raise ValueError(f"support: expected at least {len(self.rig)} views, got {len(support)}")
        self.rig.copy_(_standpoints(support)[: len(self.rig)])

    def arrange(self, support: Views) -> Views:
        """One support view a plane, each the nearest to where the training rig has one.

        More views than planes: the best matching ones, none twice. Fewer: some stand for several planes.

        Raises:
            ValueError: no view.
        """
        from scipy.optimize import linear_sum_assignment

        if not len(support):
            raise ValueError("support: expected at least one view, got none")
        cost = (1 - self.rig @ _standpoints(support).T).double().cpu().numpy()
        repeats = -(-len(self.rig) // len(support))
        _, column = linear_sum_assignment(np.tile(cost, (1, repeats)))
        return support[torch.as_tensor(column % len(support))]

    def prepare(self, support: Views) -> Prepared:
        """The planes in order and the hull."""
        views = self.arrange(support)
        return Prepared(views, ImagePlanes(views.images, views.cameras), hull(support, self.config.hull_side))

    def hyperplanes(self) -> Int[Tensor, " k"]:
        """Which planes the hypernetwork reads: k of the rig, spread as far apart as they can be."""
        count = self.hypernetwork.config.views if self.hypernetwork else 0
        chosen = [0]
        nearest = self.rig @ self.rig[0]
        while len(chosen) < count:
            chosen.append(int(nearest.argmin()))
            nearest = torch.maximum(nearest, self.rig @ self.rig[chosen[-1]])
        return torch.tensor(chosen[:count])

    def update(self, prepared: Prepared, hypernetwork: HyperNetwork | None = None) -> Parameters:
        """The update of theta, in one forward pass (HyperPlanes, Eq. 7); empty without a hypernetwork.

        Args:
            prepared: the object.
            hypernetwork: another than the model's own, as fine-tuning makes one; theta is frozen then.

        Returns:
            One tensor a parameter of the updated layers.
        """
        theta = self.theta if hypernetwork is None else self.theta.detach()
        hypernetwork = hypernetwork or self.hypernetwork
        if hypernetwork is None:
            return Parameters()
        chosen = self.hyperplanes()
        images = prepared.views.images[chosen]
        directions = camera.viewing_directions(prepared.views.cameras)[chosen]
        return hypernetwork(images, directions, theta)

    def field(self, prepared: Prepared, parameters: Parameters) -> AdaptedField:
        """The field of given weights on prepared planes (HyperPlanes, Eq. 5)."""
        planes = prepared.planes if self.config.target != "nerf" else None
        bounds = prepared.occupancy.bounds
        bound = {
            name: cast(Target, network).bind(parameters.under(name), planes, bounds)
            for name, network in self.networks.items()
        }
        densities = tuple(field.density for field in bound.values())
        return AdaptedField(bound["fine"], prepared.occupancy, self.config.sampling, bound.get("coarse"), densities)

    @torch.no_grad()
    def adapt(self, support: Views) -> AdaptedField:
        """The field of one object in a single step: theta + delta (HyperPlanes, Eq. 6)."""
        self.eval()
        prepared = self.prepare(support)
        return self.field(prepared, self.theta + self.update(prepared))

    def fine_tune(
        self,
        support: Views,
        steps: int,
        *,
        rays: int = 1024,
        learning_rate: float = 3e-4,
        seed: int = 0,
    ) -> AdaptedField:
        """The field of one object after some more steps of the hypernetwork on its support views, theta frozen.

        The model itself stays as it is (HyperPlanes, section 3, fine-tuning).

        Args:
            support: the views of the object.
            steps: Adam steps on rays of the support views.
            rays: a step.
            learning_rate: of Adam.
            seed: of the rays and their samples.

        Returns:
            The field of theta + delta, delta by the refined hypernetwork.

        Raises:
            ValueError: a model without a hypernetwork.
        """
        if self.hypernetwork is None:
            raise ValueError("fine_tune: expected a model with a hypernetwork, got one without")
        self.eval()
        prepared = self.prepare(support)
        tuned = copy.deepcopy(self.hypernetwork)
        theta = self.theta.detach()
        optimiser = torch.optim.Adam(tuned.parameters(), learning_rate)
        generator = torch.Generator().manual_seed(seed)
        marched = isinstance(self.config.sampling, Marched)
        live = footprint(prepared.occupancy, support.cameras).flatten().nonzero()[:, 0] if marched else None
        span = "sphere" if marched else "depth"
        with torch.enable_grad():
            for _ in range(steps):
                field = self.field(prepared, theta + self.update(prepared, tuned))
                sampled, truth = support.sample_rays(rays, generator=generator, among=live, span=span)
                seen = field.trace(sampled, generator)
                loss = (seen.colour - truth).square().mean()
                if seen.coarse is not None:
                    loss = loss + (seen.coarse - truth).square().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
        with torch.no_grad():
            return self.field(prepared, theta + self.update(prepared, tuned))

    def save(self, folder: Path | str) -> None:
        """Write model.json and model.safetensors."""
        folder = Path(folder)
        save_tensors(folder / "model.safetensors", self.state_dict())
        write_json(folder / "model.json", self.config.as_json())

    @classmethod
    def from_pretrained(cls, folder: Path | str) -> HyperPlanes:
        """The model that `save` wrote; CheckpointError where a file is missing, damaged or of another architecture."""
        folder = Path(folder)
        model = cls(ModelConfig.of_json(read_json(folder / "model.json")))
        model.load_state_dict(load_tensors(folder / "model.safetensors", model.state_dict()))
        return model.eval()


def _standpoints(views: Views) -> Float[Tensor, "view 3"]:
    """Unit vectors from the scene's centre to the cameras."""
    centre = views.images.new_tensor(views.bounds.centre)
    return torch.nn.functional.normalize(camera.centres(views.cameras) - centre, dim=-1)
