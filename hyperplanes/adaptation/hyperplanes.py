"""HyperPlanes: a target network, the hypernetwork that writes its update, and the checkpoint that holds them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hyperplanes.adaptation.base import AdaptedField, hull
from hyperplanes.adaptation.configuration import ModelConfig, checkpoint_folder
from hyperplanes.adaptation.fine_tuning import GRID_RATES, FineTuning, Hiding, Steps, best_stop, minimise
from hyperplanes.adaptation.matching import match, standpoints, superfluous
from hyperplanes.adaptation.prepared import Prepared
from hyperplanes.fields import Target, find_targets
from hyperplanes.geometry import cameras as camera
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.poses import farthest_first
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.geometry.volume import CHANNELS, SIDE, volume_of
from hyperplanes.hypernetwork import VOLUME, Autoencoder, HyperNetwork, Reader, VolumeHyperNetwork
from hyperplanes.parameters import Parameters
from hyperplanes.rendering.footprint import footprint
from hyperplanes.utilities.checkpoints import CheckpointError, load_tensors, save_tensors
from hyperplanes.utilities.files import write_json
from hyperplanes.views import Views

__all__ = ["HyperPlanes", "ModelConfig"]

VOXELS_PER_PIXEL = 3 / 4  # of a side of the pictures: 96 voxels for 128 pixels, as the preset "small" is trained
FINEST_HULL = 192


class HyperPlanes(nn.Module):
    """theta, the hypernetwork that updates it, and the rig of support views it was trained with.

    Without a hypernetwork the same weights serve every object: the plain target network that the paper compares with.

    An MLP that concatenates what n planes say knows each plane by its place, so views of any other rig are matched to
    the one of the training (`arrange`). Fields of the target "any_order" need no rig: they take any number of views as
    they come. Views are taken to where the weights are.

    Args:
        config: what it is made of.
        seed: of the weights; the global random state is left alone.

    Raises:
        ValueError: an unknown field, encoder or layer, or more HyperPlanes than planes.
    """

    rig: Tensor

    def __init__(self, config: ModelConfig, seed: int = 0) -> None:
        super().__init__()
        targets = find_targets()
        if config.target not in targets:
            raise ValueError(f"target: expected one of {sorted(targets)}, got {config.target!r}")
        planes = config.network.planes
        reader = config.hypernetwork or config.autoencoder
        self.any_order = targets[config.target].any_order
        self.reads_volume = config.hypernetwork is not None and config.hypernetwork.encoder == VOLUME
        if self.reads_volume and not self.any_order:
            raise ValueError(
                f"encoder: expected one that reads images for {config.target}, which knows views by their places, "
                f"got {VOLUME!r}"
            )
        takes_any = self.reads_volume or (config.hypernetwork and config.hypernetwork.join == "mean")
        if self.any_order and reader and not takes_any:
            found = "an autoencoder" if config.hypernetwork is None else repr(config.hypernetwork.join)
            raise ValueError(
                f"{config.target}: expected a hypernetwork with encoder {VOLUME!r}, or with join 'mean', which takes "
                f"HyperPlanes in any number and order, got {found}"
            )
        if reader and reader.views > planes and not self.any_order:
            raise ValueError(f"views: expected at most as many HyperPlanes as planes, {planes}, got {reader.views}")
        if config.plane_dropout and (self.any_order or config.target == "nerf"):
            raise ValueError(f"plane_dropout: expected a field that knows planes by their places, got {config.target}")
        if config.second_pass and not self.any_order:
            raise ValueError(f"second_pass: expected a field that judges what views see, got {config.target}")
        self.config = config
        make = targets[config.target]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.networks = nn.ModuleDict({"fine": make(config.network)})
            if config.coarse_network:
                self.networks["coarse"] = make(config.network)
            shapes = {name: value.shape for name, value in self.networks.named_parameters()}
            self.hypernetwork: Reader | None = None
            if config.hypernetwork and self.reads_volume:
                self.hypernetwork = VolumeHyperNetwork(config.hypernetwork, shapes, CHANNELS, SIDE)
            elif config.hypernetwork:
                self.hypernetwork = HyperNetwork(config.hypernetwork, shapes)
            elif config.autoencoder:
                read = cast(Target, self.networks["fine"]).reading_layers
                self.hypernetwork = Autoencoder(config.autoencoder, shapes, read)
        self.register_buffer("rig", torch.zeros(0 if self.any_order else planes, 3))

    @property
    def theta(self) -> Parameters:
        """The universal weights, shared with the module."""
        return Parameters.of(self.networks)

    def set_rig(self, support: Views) -> None:
        """Take the standpoints of these support views as the order of the planes; a model of any order has none.

        Raises:
            ValueError: fewer views than planes.
        """
        if len(support) < len(self.rig):
            raise ValueError(f"support: expected at least {len(self.rig)} views, one a plane, got {len(support)}")
        self.rig.copy_(standpoints(support)[: len(self.rig)])

    def arrange(self, support: Views) -> Views:
        """One support view a plane, each the nearest to where the training rig has one; all as they are for any order.

        More views than planes: the best matching ones, none twice. Fewer: some stand for several planes. With order
        "file" the views stay in their order: the first ones, and again from the first where there are too few.

        Raises:
            ValueError: no view, or a model that was never shown its rig.
        """
        if not len(support):
            raise ValueError("support: expected at least one view, got none")
        return support if self.any_order else support[self._places(support)]

    def _places(self, support: Views) -> Int[Tensor, " plane"]:
        """The index of the view at each plane, as `arrange` places them."""
        if self.config.order == "file":
            places = torch.arange(len(self.rig)) % len(support)
        else:
            places = match(self._known_rig(), standpoints(support).cpu())
        return places.to(support.images.device)

    def prepare(self, support: Views, *, carved: bool = True) -> Prepared:
        """The planes in order and the hull.

        Args:
            support: the views of one object, on any device and in any precision.
            carved: without, one voxel that may hold anything stands for the hull, for who never asks it. A hypernetwork
                that reads the hull has it carved in any case.

        Returns:
            All that depends on the support views and not on weights.
        """
        support = self._to_own(support)
        views = self.arrange(support)
        carved = carved or self.reads_volume
        region = hull(support, self._hull_side(support)) if carved else full(support.bounds, 1, support.images.device)
        planes = cast(Target, self.networks["fine"]).planes_of(views, region)
        if self.config.plane_dropout and len(support) < len(views):
            places, near = self._places(support), torch.zeros(len(views))
            if self.config.order != "file":
                near = (self._known_rig() * standpoints(views).cpu()).sum(1)
            planes = planes.hiding(superfluous(places, near).to(self.rig.device))
        return Prepared(views, planes, region, volume_of(planes) if self.reads_volume else None)

    def _hull_side(self, support: Views) -> int:
        """Voxels an axis of the hull; for a field of any order more than configured where pictures are larger."""
        side = self.config.hull_side
        if not self.any_order or support.masks is None:
            return side
        return max(side, min(FINEST_HULL, round(VOXELS_PER_PIXEL * max(support.size))))

    def hyperplanes(self, views: Views | None = None) -> Int[Tensor, " k"]:
        """Which planes the hypernetwork reads: k of the rig, spread as far apart as they can be, or the first k.

        Args:
            views: arranged; they count for a model of any order, which reads at most k of them, or all as a volume.

        Returns:
            Indices of planes. A model that was never shown its rig raises ValueError.
        """
        if self.reads_volume and views is not None:
            return torch.arange(len(views), device=self.rig.device)
        count = self.hypernetwork.config.views if self.hypernetwork else 0
        standing = standpoints(views).cpu() if self.any_order and views is not None else None
        count = count if standing is None else min(count, len(standing))
        if self.hypernetwork and self.hypernetwork.config.choice == "first":
            return torch.arange(count, device=self.rig.device)
        if standing is not None:
            first = int((standing @ standing.mean(0)).argmin())
        else:
            standing, first = self._known_rig(), 0
        return torch.tensor(farthest_first(standing, first, count), device=self.rig.device)

    def _known_rig(self) -> Float[Tensor, "plane 3"]:
        """The rig on the CPU, where views are matched to it."""
        rig = self.rig.float().cpu()
        if not rig.any():
            raise ValueError(
                "rig: expected the standpoints of the training's views, got none; set_rig takes them from views"
            )
        return rig

    def _to_own(self, support: Views) -> Views:
        """The views where the weights are, in their precision or at least single."""
        return support.to(self.rig.device, torch.promote_types(self.rig.dtype, torch.float32))

    def update(self, prepared: Prepared, hypernetwork: Reader | None = None) -> Parameters:
        """The update of theta, in one forward pass (HyperPlanes, Eq. 7); empty without a hypernetwork.

        Args:
            prepared: the object.
            hypernetwork: another than the model's own, as fine-tuning makes one; theta is frozen then.

        Returns:
            One tensor a parameter of the updated layers.
        """
        return self.updates([prepared], hypernetwork)[0]

    def updates(self, prepared: Sequence[Prepared], hypernetwork: Reader | None = None) -> list[Parameters]:
        """The updates of several objects, whose HyperPlanes are encoded in one batch; as `update`."""
        theta = self.theta if hypernetwork is None else self.theta.detach()
        hypernetwork = hypernetwork or self.hypernetwork
        if hypernetwork is None:
            return [Parameters() for _ in prepared]
        if isinstance(hypernetwork, VolumeHyperNetwork):
            volumes = [each.volume for each in prepared if each.volume is not None]
            return hypernetwork(torch.stack(volumes), theta)
        read = [each.views[self.hyperplanes(each.views)] for each in prepared]
        directions = [camera.viewing_directions(each.cameras) for each in read]
        side = hypernetwork.config.resolution if isinstance(hypernetwork, HyperNetwork) else 0
        images = [_resized(each.images, (side, side) if side else read[0].size) for each in read]
        if not self.any_order:
            return cast("list[Parameters]", hypernetwork(torch.stack(images), torch.stack(directions), theta))
        present = [torch.ones(len(each), device=each.device) for each in directions]
        batch = [pad_sequence(part, batch_first=True) for part in (images, directions, present)]
        return cast("list[Parameters]", hypernetwork(batch[0], batch[1], theta, batch[2] > 0))

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
    def adapt(self, support: Views | Prepared) -> AdaptedField:
        """The field of one object in a single step: theta + delta (HyperPlanes, Eq. 6)."""
        prepared = support if isinstance(support, Prepared) else self.prepare(support)
        with _in_use(self):
            return self.rendering_field(prepared, self.theta + self.update(prepared))

    def rendering_field(self, prepared: Prepared, parameters: Parameters) -> AdaptedField:
        """As `field`, after a second pass where the model takes two."""
        return self.field(self._second_pass(prepared, parameters), parameters)

    def _second_pass(self, prepared: Prepared, weights: Parameters) -> Prepared:
        """The planes with the surface that these weights show to each of them, where the model takes two passes."""
        if not self.config.second_pass:
            return prepared
        planes = prepared.planes
        assert isinstance(planes, VisibilityPlanes)
        seen = self.field(prepared, weights).render(prepared.views.cameras)
        return replace(prepared, planes=planes.with_surface(seen.depth[:, 0], seen.opacity[:, 0]))

    def fine_tune(
        self,
        support: Views | Prepared,
        steps: Steps,
        settings: FineTuning | None = None,
        *,
        on_step: Callable[[int], None] | None = None,
        on_trial: Callable[[int], None] | None = None,
    ) -> AdaptedField:
        """The field of one object after gradient steps on its support views; the model itself stays as it is.

        It begins at theta + delta, the field of `adapt`. Either these weights themselves are optimised, or, as in the
        paper, a copy of the hypernetwork while theta is frozen (HyperPlanes, section 3, fine-tuning).

        Args:
            support: the views of the object; of one that is prepared, those that are planes.
            steps: gradient steps on rays of the support views, or "auto": as many, up to `settings.longest`, as show
                support views best that were left out for the purpose; 0 where every step made those worse.
            settings: what is optimised, rates, rays and seed.
            on_step: called with the number of steps done, before the first and after each.
            on_trial: likewise, while "auto" finds how many they are to be; there are up to `settings.longest`.

        Returns:
            The field. A model that takes a second pass takes it twice: the steps keep the surface of the weights that
            they begin with, and the field has that of its own.

        Raises:
            ValueError: the hypernetwork of a model that has none, a negative number of steps, "auto" with fewer than 3
                views, or a single view of a field that takes any number of them, unless `settings.hide` is off.
        """
        settings = settings or FineTuning()
        if self.config.network.grid and settings.free == "weights":
            settings = settings.with_rates(GRID_RATES)
        if settings.free == "hypernetwork" and self.hypernetwork is None:
            raise ValueError("fine_tune: expected a model with a hypernetwork, got one without")
        if steps != "auto" and steps < 0:
            raise ValueError(f"steps: expected 0 or more, or 'auto', got {steps}")
        given, support = support, support.views if isinstance(support, Prepared) else self._to_own(support)
        if steps and len(support) == 1 and self.any_order and settings.hide:
            raise ValueError(
                f"steps: expected 0 with a single view, whose colours {self.config.target} would learn to copy, got "
                f"{steps}; give 2 views or more"
            )
        schedule = stop = settings.longest if steps == "auto" else steps
        if steps == "auto":
            stop = self._best_stop(support, settings, on_trial)
        prepared = given if isinstance(given, Prepared) else self.prepare(support)
        weights, variables = self._tunable(prepared, settings)
        field, pixels = self._hiding(prepared, weights), self._live_pixels(prepared, support)
        for done in minimise(field, variables, support, schedule, settings, pixels=pixels, hiding=self.any_order):
            if on_step is not None:
                on_step(done)
            if done == stop:
                break
        with torch.no_grad():
            return self.rendering_field(prepared, weights())

    def _best_stop(self, support: Views, settings: FineTuning, on_step: Callable[[int], None] | None) -> int:
        """How many steps of fine-tuning show left-out views best; they are neither planes nor give rays meanwhile."""
        if len(support) < 3:
            raise ValueError(f"steps: expected at least 3 support views to choose their number by, got {len(support)}")
        every = min(settings.left_out, len(support))
        left_out = torch.arange(len(support)) % every == every // 2
        shown, judged = support[(~left_out).nonzero()[:, 0]], support[left_out.nonzero()[:, 0]]
        prepared = self.prepare(shown)
        weights, variables = self._tunable(prepared, settings)
        return best_stop(
            self._hiding(prepared, weights),
            variables,
            shown,
            judged,
            settings,
            pixels=self._live_pixels(prepared, shown),
            judged=self._live_pixels(prepared, judged),
            hiding=self.any_order,
            on_step=on_step,
        )

    def _tunable(self, prepared: Prepared, settings: FineTuning) -> tuple[Callable[[], Parameters], Sequence[Tensor]]:
        """The weights of the field as a function of what fine-tuning optimises, and the tensors that it optimises."""
        if settings.free == "hypernetwork":
            tuned = copy.deepcopy(self.hypernetwork)
            assert tuned is not None
            tuned = tuned.eval().requires_grad_(True)
            theta = self.theta.detach()
            return lambda: theta + self.update(prepared, tuned), [*tuned.parameters()]
        with torch.no_grad(), _in_use(self):
            start = self.theta + self.update(prepared)
        free = Parameters((name, value.detach().clone().requires_grad_(True)) for name, value in start.items())
        return lambda: free if torch.is_grad_enabled() else free.detach(), list(free.values())

    def _hiding(self, prepared: Prepared, weights: Callable[[], Parameters]) -> Hiding:
        """The field of these weights; of a second pass, the surface is that of the weights as they are now."""
        with torch.no_grad():
            judged = self._second_pass(prepared, weights())
        return lambda hidden: self.field(judged if hidden is None else judged.hiding(hidden), weights())

    def _live_pixels(self, prepared: Prepared, views: Views) -> Int[Tensor, " pixel"] | None:
        """Flat indices of the pixels of views that look into the hull; None where all are drawn from."""
        if not self.config.sampling.needs_occupancy:
            return None
        return footprint(prepared.occupancy, views.cameras).flatten().nonzero()[:, 0]

    def save(self, folder: Path | str, dtype: torch.dtype | None = None) -> None:
        """Write model.json and model.safetensors.

        Args:
            folder: made where absent.
            dtype: of the weights in the file, such as float16, which halves it; their own where absent. Statistics stay
                as they are, and `from_pretrained` makes single precision of all.
        """
        folder, weights = Path(folder), self.state_dict()
        if dtype is not None:
            weights |= {name: value.to(dtype) for name, value in self.named_parameters()}
        save_tensors(folder / "model.safetensors", weights)
        write_json(folder / "model.json", self.config.as_json())

    @classmethod
    def from_pretrained(cls, name: Path | str) -> HyperPlanes:
        """The model that `save` wrote.

        Args:
            name: its folder, or the name of a model that comes with the package; a folder of that name goes first.

        Returns:
            The model, ready for use.

        Raises:
            CheckpointError: no such folder or name, a file that is missing or damaged, or weights of another
                architecture than the configuration says; nothing is allocated for those.
        """
        folder = checkpoint_folder(name)
        config = ModelConfig.load(folder)
        try:
            with torch.device("meta"):  # names and shapes alone, to be compared with what the file holds
                model = cls(config)
        except ValueError as error:
            raise CheckpointError(f"{folder / 'model.json'}: {error}; train again with this version") from None
        expected = model.state_dict()
        weights = load_tensors(folder / "model.safetensors", expected)
        model.load_state_dict({name: weights[name].to(value.dtype) for name, value in expected.items()}, assign=True)
        return model.eval()


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


def _resized(images: Float[Tensor, "view 3 height width"], size: tuple[int, int]) -> Tensor:
    """Images of that size, by the mean of the pixels that one covers where there are more."""
    return images if images.shape[2:] == size else torch.nn.functional.interpolate(images, size, mode="area")
