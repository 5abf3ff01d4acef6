"""Methods by name: what `evaluate --method` takes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from hyperplanes.adaptation.base import AdaptedField, Adapter, Renderable
from hyperplanes.adaptation.fine_tuned import FieldFromScratch, FineTuned, FromScratch, random_model, shuffled
from hyperplanes.adaptation.hull_blend import HullBlend
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.nearest_view import NearestView
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.configuration.presets import configure
from hyperplanes.fields import find_targets
from hyperplanes.rendering.samplers import Sampler
from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.views import Views

__all__ = ["METHODS", "Method", "at_steps", "WithSampler", "describe_method", "find_methods", "make_method"]

METHODS: dict[str, str] = {
    "nearest_view": "the nearest support view, copied",
    "hull_blend": "support views blended on the visual hull",
    "nerf": "NeRF, one set of weights for all objects",
    "multiplane": "MultiPlaneNeRF, one set of weights for all objects",
    "point_multiplane": "PointMultiPlaneNeRF, one set of weights for all objects",
    "hyperplanes": "HyperPlanes in one step",
    "hyperplanes_swapped": "HyperPlanes with the update of another object",
    "autoencoder": "a field that reads the code of an encoder",
    "scratch": "the same field from random weights",
    "nerf_scratch": "NeRF of one object from random weights",
    "multiplane_scratch": "MultiPlaneNeRF of one object from random weights",
    "point_multiplane_scratch": "PointMultiPlaneNeRF of one object from random weights",
    "standard": "random weights, optimised as the learned initialisations are",
    "mv_shuffled": "the weights of mv_meta in random order",
    **LEARNED,
}
"""Names and what they stand for. All but nearest_view, hull_blend and hyperplanes_swapped take _N, N gradient steps on
the support views, or _auto, as many as serve views that are left out. Those with "scratch" need one of the two; an
initialisation without is optimised for as many steps as its checkpoint says."""

_NAME = re.compile(r"(?P<base>.+?)(?:_(?P<steps>\d+|auto))?")
_WITHOUT_STEPS = ("nearest_view", "hull_blend", "hyperplanes_swapped")
_INITIALISATIONS = ("standard", "mv_shuffled", *LEARNED)
_NEED_STEPS = ("scratch", "nerf_scratch", "multiplane_scratch", "point_multiplane_scratch")


@dataclass(frozen=True)
class Method:
    """A method of another package, which names it by an entry point of the group `hyperplanes.methods`.

    Attributes:
        about: what it stands for.
        make: its adapter; called with `checkpoints`, `device`, `settings` and `objects`, as `make_method` is.
    """

    about: str
    make: Callable[..., Adapter]


def find_methods() -> dict[str, Method]:
    """The methods of the other packages that are installed, by name."""
    return load_entries("hyperplanes.methods", METHODS)


def _parse(name: str) -> tuple[str, Steps | None]:
    """The entry of METHODS and the number of steps.

    Raises:
        ValueError: no method has that name.
    """
    if name in (registered := find_methods()):
        return name, None
    match = _NAME.fullmatch(name)
    base, steps = (match["base"], match["steps"]) if match else (name, None)
    if (
        (base not in METHODS and base not in find_targets())
        or (steps and base in _WITHOUT_STEPS)
        or (base in _NEED_STEPS and not steps)
    ):
        every = {**METHODS, **find_targets(), **registered}
        known = ", ".join(f"{each}_N" if each in _NEED_STEPS else each for each in every)
        raise ValueError(
            f"method: expected one of {known}, with _N or _auto after it for so many gradient steps, got {name!r}"
        )
    return base, steps if steps in (None, "auto") else int(steps)


def at_steps(name: str, steps: Sequence[int]) -> list[str]:
    """The names of a method after each of some numbers of gradient steps; itself where it takes none.

    >>> at_steps("hyperplanes", [0, 10])
    ['hyperplanes', 'hyperplanes_10']

    Args:
        name: without steps, or it stays alone.
        steps: 0 is the method itself, of an initialisation its weights as they are; "scratch" has no such row.
    """
    if not steps or name in _WITHOUT_STEPS or name in find_methods() or _NAME.fullmatch(name)["steps"]:  # pyright: ignore[reportOptionalSubscript]
        return [name]
    if name in _INITIALISATIONS:
        return [f"{name}_{count}" for count in steps]
    return [f"{name}_{count}" if count else name for count in steps if count or name not in _NEED_STEPS]


def describe_method(name: str) -> str:
    """A method in words.

    >>> describe_method("hyperplanes_100")
    'HyperPlanes after 100 fine-tuning steps'

    Args:
        name: such as "hyperplanes_100".
    """
    base, steps = _parse(name)
    registered = find_methods()
    plain = METHODS.get(base, f"{base}, one set of weights for all objects")
    whole = registered[base].about if base in registered else plain
    if steps is None:
        return whole
    about = whole.removesuffix(" in one step").replace(", one set of weights for all objects", "")
    if base in _NEED_STEPS or base in _INITIALISATIONS:
        return f"{about}, {'as many steps as left-out views ask for' if steps == 'auto' else f'{steps} steps'}"
    count = "as many fine-tuning steps as left-out views ask for" if steps == "auto" else f"{steps} fine-tuning steps"
    return f"{about} after {count}"


def make_method(
    name: str,
    checkpoints: Mapping[str, Path],
    *,
    device: torch.device | str = "cpu",
    settings: FineTuning | None = None,
    objects: Iterable[Views] = (),
    preset: str = "quick",
    protocol: str = "default",
) -> Adapter:
    """The adapter behind a method's name.

    Args:
        name: one of METHODS, perhaps with a number of steps.
        checkpoints: folders by the names of the methods that trained them, such as "hyperplanes".
        device: where its weights go.
        settings: of fine-tuning.
        objects: the support views of the objects that will be asked for; "hyperplanes_swapped" reads them.
        preset: the shape of the fields that need no checkpoint.
        protocol: how those are sampled while they are optimised, as in `presets.configure`.

    Returns:
        An adapter; ValueError for an unknown name, or a checkpoint that the method needs and that is not given.
    """
    base, steps = _parse(name)
    settings = settings or FineTuning()
    if base in (registered := find_methods()):
        return registered[base].make(checkpoints=checkpoints, device=device, settings=settings, objects=objects)
    if base == "nearest_view":
        return NearestView()
    if base == "hull_blend":
        return HullBlend()
    if base.endswith("_scratch"):
        assert steps is not None
        config = configure(preset, base.removesuffix("_scratch"), protocol=protocol).model
        return FieldFromScratch(config, steps, settings, device)
    if base in _INITIALISATIONS:
        return _initialisation(name, checkpoints, device, settings, preset, protocol)
    family = "hyperplanes" if base == "hyperplanes_swapped" else base
    if base == "scratch":  # the architecture of any checkpoint that there is
        family = next((each for each in ("hyperplanes", *checkpoints) if each in checkpoints), "hyperplanes")
    model = _load(name, family, checkpoints).to(device)
    if base == "hyperplanes_swapped":
        return Swapped(model, objects)
    if base == "scratch":
        assert steps is not None
        return FromScratch(model, steps, settings)
    return model if steps is None else FineTuned(model, steps, settings)


def _initialisation(
    name: str,
    checkpoints: Mapping[str, Path],
    device: torch.device | str,
    settings: FineTuning,
    preset: str,
    protocol: str,
) -> FineTuned:
    """Gradient descent from learned weights, or from those that they are compared with."""
    base, steps = _parse(name)
    if base == "standard":  # the architecture of the initialisations that it stands beside
        family = next((each for each in LEARNED if each in checkpoints), None)
        if family is None:
            config, rig = replace(configure(preset, "mv_meta", protocol=protocol).model, order="file"), None
        else:
            trained = _load(name, family, checkpoints)
            config, rig = trained.config, trained.rig
        model = random_model(config, settings.seed)
        if rig is not None:
            model.rig.copy_(rig)
    else:
        model = _load(name, "mv_meta" if base == "mv_shuffled" else base, checkpoints)
        config = model.config
        if base == "mv_shuffled":
            model = shuffled(model, settings.seed)
    assert config.initialisation is not None
    steps = config.initialisation.steps if steps is None else steps
    return FineTuned(model.to(device), steps, config.initialisation.descent(given=settings))


def _load(name: str, family: str, checkpoints: Mapping[str, Path]) -> HyperPlanes:
    """The model of a checkpoint that a method needs."""
    if family not in checkpoints:
        more = "" if name.split("_")[0] != "scratch" else f"; or name the field, as point_multiplane_{name}"
        raise ValueError(
            f"method {name}: expected a checkpoint of {family}, got none; `hyperplanes train` makes one{more}"
        )
    return HyperPlanes.from_pretrained(checkpoints[family])


@dataclass(frozen=True)
class WithSampler:
    """A method whose fields are rendered by another protocol than the one they were trained by.

    Attributes:
        adapter: the method.
        sampling: the protocol; None leaves all as it is. What is no field is not sampled, and stays as it is.
    """

    adapter: Adapter
    sampling: Sampler | None

    def adapt(self, support: Views) -> Renderable:
        """What the method makes of one object."""
        made = self.adapter.adapt(support)
        if self.sampling is None or not isinstance(made, AdaptedField):
            return made
        return replace(made, sampling=self.sampling)
