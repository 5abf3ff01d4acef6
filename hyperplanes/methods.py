"""The registry of methods, of this package and of others, by the names that `evaluate --method` takes.

If a method allows it, its name may end in a number of gradient steps on the support views (`hyperplanes_100`), in
`_auto` for the number that is best for held-out views, or in `_swapped` to give each object the update of another one.
Another package adds a method by an entry point of the group `hyperplanes.methods` that names a `Method`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from hyperplanes.adaptation.base import AdaptedField, Adapter, Renderable
from hyperplanes.adaptation.baselines.hull_blend import HullBlend
from hyperplanes.adaptation.baselines.nearest_view import NearestView
from hyperplanes.adaptation.fine_tuned import FieldFromScratch, FineTuned, FromScratch, random_model, shuffled
from hyperplanes.adaptation.fine_tuning import ignoring_no_progress
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.adaptation.symmetry.detection import ReflectedHullBlend
from hyperplanes.configuration.fine_tuning import FineTuning, Steps
from hyperplanes.configuration.initialisation import LEARNED
from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.presets import Preset, preset
from hyperplanes.fields import find_targets
from hyperplanes.rendering.sampling.samplers import Sampler
from hyperplanes.utilities.entry_points import load_entries
from hyperplanes.utilities.messages.errors import did_you_mean
from hyperplanes.views import Views

__all__ = [
    "METHODS",
    "Method",
    "Request",
    "Unchecked",
    "WithSampler",
    "at_steps",
    "describe_method",
    "find_methods",
    "is_method",
    "make_method",
]


@dataclass(frozen=True)
class Request:
    """The arguments from which `make_method` makes a method.

    Attributes:
        name: the requested name, such as "hyperplanes_100".
        checkpoints: the folders of checkpoints, by the names of the methods that were trained, such as "hyperplanes".
        device: the device of the weights.
        settings: the settings of fine-tuning.
        objects: the support views of the objects to adapt to; only "hyperplanes_swapped" reads them.
        preset: the preset, or its name, that configures fields without a checkpoint.
        protocol: how such fields are sampled while they are optimised, as in `Preset.by_protocol`.
        reflections: whether models may use reflections of the views of a symmetric object.
        steps: gradient steps on the support views of an object, "auto", or None where the name has no number;
            `make_method` reads them from the name.
    """

    name: str
    checkpoints: Mapping[str, Path] = field(default_factory=dict)
    device: torch.device | str = "cpu"
    settings: FineTuning = field(default_factory=FineTuning)
    objects: Iterable[Views] = ()
    preset: str | Preset = "quick"
    protocol: str = "default"
    reflections: bool = True
    steps: Steps | None = None

    def configured(self, method: str) -> ModelConfig:
        """The model configuration of a method at the scale of the preset."""
        chosen = preset(self.preset) if isinstance(self.preset, str) else self.preset
        return chosen.by_protocol(self.protocol).by_method(method).model

    def model(self, method: str) -> HyperPlanes:
        """The model of the checkpoint of a method, on the device.

        Raises:
            ValueError: no such checkpoint was given.
        """
        if method not in self.checkpoints:
            alone = f"; or name the field, as point_multiplane_{self.name}" if self.name.startswith("scratch") else ""
            raise ValueError(
                f"method {self.name}: expected a checkpoint of {method}, got none; `hyperplanes train` makes one{alone}"
            )
        model = HyperPlanes.from_pretrained(self.checkpoints[method]).to(self.device)
        return model if self.reflections else model.without_reflections()

    @property
    def needed_steps(self) -> Steps:
        """The number of steps of a method whose name always has one."""
        assert self.steps is not None
        return self.steps


@dataclass(frozen=True)
class Method:
    """A method of this or of another package.

    Attributes:
        about: a description.
        make: makes its adapter.
        steps: whether its name takes a number of gradient steps: "none", "optional", or "required".
        tuned: the description for "... after N fine-tuning steps"; empty if the steps are part of the method itself.
        begins_at_zero: whether 0 steps are written _0, because the name without a number means another number of steps.
        swapped: makes the control in which each object gets the update of another, if there is one.
    """

    about: str
    make: Callable[[Request], Adapter]
    steps: Literal["none", "optional", "required"] = "none"
    tuned: str = ""
    begins_at_zero: bool = False
    swapped: Callable[[Request], Adapter] | None = None

    def describe(self, steps: Steps | None) -> str:
        """The description of the method with a number of steps."""
        if steps is None:
            return self.about
        kind = "fine-tuning steps" if self.tuned else "steps"
        count = f"a number of {kind} chosen by held-out views" if steps == "auto" else f"{steps} {kind}"
        return f"{self.tuned} after {count}" if self.tuned else f"{self.about}, {count}"


def _of_checkpoint(name: str) -> Callable[[Request], Adapter]:
    """A function that loads the model of a method's checkpoint, with fine-tuning if steps are requested."""

    def make(request: Request) -> Adapter:
        model = request.model(name)
        return model if request.steps is None else FineTuned(model, request.steps, request.settings)

    return make


def _shared_weights(name: str, about: str) -> Method:
    """A field whose weights are the same for all objects."""
    return Method(f"{about}, one set of weights for all objects", _of_checkpoint(name), "optional", tuned=about)


def _scratch(request: Request) -> Adapter:
    """The architecture of an available checkpoint, from random weights."""
    known = ("hyperplanes", *request.checkpoints)
    family = next((each for each in known if each in request.checkpoints), "hyperplanes")
    return FromScratch(request.model(family), request.needed_steps, request.settings)


def _field_scratch(name: str, request: Request) -> Adapter:
    """A field of the preset's shape, from random weights."""
    config = request.configured(name)
    return FieldFromScratch(config, request.needed_steps, request.settings, request.device)


def _optimised(model: HyperPlanes, request: Request, trained: ModelConfig | None = None) -> FineTuned:
    """Gradient descent from the weights of a model, as configured in the model or in another, trained one.

    Raises:
        ValueError: settings that do not optimise the weights.
    """
    if request.settings.trainable != "weights":
        found = request.settings.trainable
        raise ValueError(f"fine_tune: expected weights for {request.name}, which has no hypernetwork, got {found}")
    initialisation = (trained or model.config).initialisation
    assert initialisation is not None
    steps = initialisation.steps if request.steps is None else request.steps
    return FineTuned(model.to(request.device), steps, initialisation.descent(given=request.settings))


def _standard(request: Request) -> Adapter:
    """Random weights in the architecture of the learned initialisations that they are compared with."""
    family = next((each for each in LEARNED if each in request.checkpoints), None)
    trained = None if family is None else request.model(family)
    config = replace(request.configured("mv_meta"), order="file")
    model = random_model(config if trained is None else trained.config, request.settings.seed)
    if trained is not None:
        model.rig.copy_(trained.rig)
    return _optimised(model, request, config if trained is None else trained.config)


METHODS: dict[str, Method] = {
    "nearest_view": Method("the nearest support view, copied", lambda request: NearestView()),
    "hull_blend": Method("support views blended on the visual hull", lambda request: HullBlend()),
    "hull_blend_reflected": Method(
        "support views and, of symmetric objects, their reflections, blended on the visual hull",
        lambda request: ReflectedHullBlend(),
    ),
    "nerf": _shared_weights("nerf", "NeRF"),
    "multiplane": _shared_weights("multiplane", "MultiPlaneNeRF"),
    "point_multiplane": _shared_weights("point_multiplane", "PointMultiPlaneNeRF"),
    "hyperplanes": Method(
        "HyperPlanes in one forward pass",
        _of_checkpoint("hyperplanes"),
        "optional",
        tuned="HyperPlanes",
        swapped=lambda request: Swapped(request.model("hyperplanes"), request.objects),
    ),
    "autoencoder": Method(
        "a field that reads the code of an encoder",
        _of_checkpoint("autoencoder"),
        "optional",
        tuned="a field that reads the code of an encoder",
    ),
    "scratch": Method("the same field from random weights", _scratch, "required"),
    **{
        f"{name}_scratch": Method(
            f"{about} of one object from random weights", partial(_field_scratch, name), "required"
        )
        for name, about in {
            "nerf": "NeRF",
            "multiplane": "MultiPlaneNeRF",
            "point_multiplane": "PointMultiPlaneNeRF",
        }.items()
    },
    "standard": Method(
        "random weights, optimised as the learned initialisations are", _standard, "optional", begins_at_zero=True
    ),
    "mv_shuffled": Method(
        "the weights of mv_meta in random order",
        lambda request: _optimised(shuffled(request.model("mv_meta"), request.settings.seed), request),
        "optional",
        begins_at_zero=True,
    ),
    **{
        name: Method(
            about,
            lambda request, name=name: _optimised(request.model(name), request),
            "optional",
            begins_at_zero=True,
        )
        for name, about in LEARNED.items()
    },
}
"""The methods of this package. Those with "scratch" need a number of steps. An initialisation without a number is
optimised for the number of steps in the configuration of its checkpoint."""

_SUFFIX = re.compile(r"(?P<base>.+)_(?P<steps>\d+|auto)")
_SWAPPED = "_swapped"


def find_methods() -> dict[str, Method]:
    """All methods by name: those of this and of other installed packages, the fields of these, and swapped controls."""
    found = METHODS | load_entries("hyperplanes.methods", METHODS)
    found |= {name: _shared_weights(name, name) for name in find_targets() if name not in found}
    swapped = {
        f"{name}{_SWAPPED}": Method(f"{method.tuned or method.about} with the update of another object", method.swapped)
        for name, method in found.items()
        if method.swapped is not None
    }
    return found | swapped


def _parse(name: str) -> tuple[str, Method, Steps | None]:
    """The name of a method without its number of steps, the method, and that number.

    Raises:
        ValueError: no method has that name, or its name takes no number or needs one.
    """
    known = find_methods()
    base, steps = name, None
    if name not in known and (match := _SUFFIX.fullmatch(name)) is not None:
        base, steps = match["base"], match["steps"]
    method = known.get(base)
    if method is None or (method.steps == "none" and steps) or (method.steps == "required" and not steps):
        listed = ", ".join(f"{each}_N" if known[each].steps == "required" else each for each in known)
        raise ValueError(
            f"method: expected one of {listed}, optionally with _N or _auto after it for N gradient steps, got {name!r}"
            + did_you_mean(base, known)
        )
    return base, method, steps if steps in (None, "auto") else int(steps)


def at_steps(name: str, steps: Sequence[int]) -> list[str]:
    """The names of a method with each of several numbers of gradient steps; its own name if it takes none.

    >>> at_steps("hyperplanes", [0, 10])
    ['hyperplanes', 'hyperplanes_10']

    Args:
        name: without a number of steps; with one, it is returned unchanged.
        steps: 0 means the method itself, or the unchanged weights of an initialisation; "scratch" skips it.
    """
    method = find_methods().get(name)
    if not steps or method is None or method.steps == "none":
        return [name]
    if method.begins_at_zero:
        return [f"{name}_{count}" for count in steps]
    return [f"{name}_{count}" if count else name for count in steps if count or method.steps == "optional"]


def describe_method(name: str) -> str:
    """The description of a method.

    >>> describe_method("hyperplanes_100")
    'HyperPlanes after 100 fine-tuning steps'

    Args:
        name: such as "hyperplanes_100".
    """
    _, method, steps = _parse(name)
    return method.describe(steps)


def is_method(name: str) -> bool:
    """Whether there is a method of a name.

    >>> is_method("hyperplanes_100"), is_method("hyperplane")
    (True, False)

    Args:
        name: as in `describe_method`.
    """
    try:
        _parse(name)
    except ValueError:
        return False
    return True


def make_method(request: Request) -> Adapter:
    """The adapter of a method.

    Returns:
        An adapter. ValueError if the name is unknown, or if the method needs a checkpoint that is not given.
    """
    _, method, steps = _parse(request.name)
    return method.make(replace(request, steps=steps))


@dataclass(frozen=True)
class WithSampler:
    """A method whose fields are rendered with another sampler than the one they were trained with.

    Attributes:
        adapter: the method.
        sampling: the sampler; None changes nothing. Results that are not fields take no samples and stay unchanged.
    """

    adapter: Adapter
    sampling: Sampler | None

    def adapt(self, support: Views) -> Renderable:
        """The result of the method for one object, with the sampler."""
        made = self.adapter.adapt(support)
        if self.sampling is None or not isinstance(made, AdaptedField):
            return made
        return made.with_sampling(self.sampling)


@dataclass(frozen=True)
class Unchecked:
    """A method that returns a fine-tuned field even if the steps made no progress, so that tables show the failure.

    Attributes:
        adapter: the method.
    """

    adapter: Adapter

    def adapt(self, support: Views) -> Renderable:
        """The result of the method for one object."""
        return ignoring_no_progress(lambda: self.adapter.adapt(support))
