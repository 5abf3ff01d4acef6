"""Methods by name: what `evaluate --method` takes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from hyperplanes.adaptation.base import AdaptedField, Adapter, Renderable
from hyperplanes.adaptation.fine_tuned import FineTuned, FromScratch
from hyperplanes.adaptation.fine_tuning import FineTuning, Steps
from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.adaptation.nearest_view import NearestView
from hyperplanes.adaptation.swapped import Swapped
from hyperplanes.entry_points import load_entries
from hyperplanes.fields import find_targets
from hyperplanes.rendering.samplers import Sampler
from hyperplanes.views import Views

__all__ = ["METHODS", "Method", "at_steps", "WithSampler", "describe_method", "find_methods", "make_method"]

METHODS: dict[str, str] = {
    "nearest_view": "the nearest support view, copied",
    "nerf": "NeRF, one set of weights for all objects",
    "multiplane": "MultiPlaneNeRF, one set of weights for all objects",
    "point_multiplane": "PointMultiPlaneNeRF, one set of weights for all objects",
    "hyperplanes": "HyperPlanes in one step",
    "hyperplanes_swapped": "HyperPlanes with the update of another object",
    "scratch": "the same field from random weights",
}
"""Names and what they stand for. All but nearest_view and hyperplanes_swapped take _N, N gradient steps on the support
views, or _auto, as many as serve views that are left out; scratch needs one of the two."""

_NAME = re.compile(r"(?P<base>.+?)(?:_(?P<steps>\d+|auto))?")
_WITHOUT_STEPS = ("nearest_view", "hyperplanes_swapped")


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
    if name in (brought := find_methods()):
        return name, None
    match = _NAME.fullmatch(name)
    base, steps = (match["base"], match["steps"]) if match else (name, None)
    if (
        (base not in METHODS and base not in find_targets())
        or (steps and base in _WITHOUT_STEPS)
        or (base == "scratch" and not steps)
    ):
        known = ", ".join(
            f"{each}_N" if each == "scratch" else each for each in {**METHODS, **find_targets(), **brought}
        )
        raise ValueError(
            f"method: expected one of {known}, with _N or _auto after it for so many fine-tuning steps, got {name!r}"
        )
    return base, steps if steps in (None, "auto") else int(steps)


def at_steps(name: str, steps: Sequence[int]) -> list[str]:
    """The names of a method after each of some numbers of fine-tuning steps; itself where it takes none.

    >>> at_steps("hyperplanes", [0, 10])
    ['hyperplanes', 'hyperplanes_10']

    Args:
        name: without steps, or it stays alone.
        steps: 0 is the method itself; "scratch" has no such row.
    """
    if not steps or name in _WITHOUT_STEPS or name in find_methods() or _NAME.fullmatch(name)["steps"]:  # pyright: ignore[reportOptionalSubscript]
        return [name]
    return [f"{name}_{count}" if count else name for count in steps if count or name != "scratch"]


def describe_method(name: str) -> str:
    """A method in words.

    >>> describe_method("hyperplanes_100")
    'HyperPlanes after 100 fine-tuning steps'

    Args:
        name: such as "hyperplanes_100".
    """
    base, steps = _parse(name)
    brought = find_methods()
    whole = brought[base].about if base in brought else METHODS.get(base, f"{base}, one set of weights for all objects")
    if steps is None:
        return whole
    about = whole.removesuffix(" in one step").replace(", one set of weights for all objects", "")
    count = "as many fine-tuning steps as left-out views ask for" if steps == "auto" else f"{steps} fine-tuning steps"
    return f"{about}, {steps} steps" if base == "scratch" and steps != "auto" else f"{about} after {count}"


def make_method(
    name: str,
    checkpoints: Mapping[str, Path],
    *,
    device: torch.device | str = "cpu",
    settings: FineTuning | None = None,
    objects: Iterable[Views] = (),
) -> Adapter:
    """The adapter behind a method's name.

    Args:
        name: one of METHODS, perhaps with a number of steps.
        checkpoints: folders by "hyperplanes", "point_multiplane" and so on.
        device: where its weights go.
        settings: of fine-tuning.
        objects: the support views of the objects that will be asked for; "hyperplanes_swapped" reads them.

    Returns:
        An adapter.

    Raises:
        ValueError: an unknown name, or a checkpoint that the method needs and that is not given.
    """
    base, steps = _parse(name)
    settings = settings or FineTuning()
    if base in (brought := find_methods()):
        return brought[base].make(checkpoints=checkpoints, device=device, settings=settings, objects=objects)
    if base == "nearest_view":
        return NearestView()
    family = "hyperplanes" if base == "hyperplanes_swapped" else base
    if base == "scratch":  # the architecture of any checkpoint that there is
        family = next((each for each in ("hyperplanes", *checkpoints) if each in checkpoints), "hyperplanes")
    if family not in checkpoints:
        raise ValueError(f"method {name}: expected a checkpoint of {family}, got none; `hyperplanes train` makes one")
    model = HyperPlanes.from_pretrained(checkpoints[family]).to(device)
    if base == "hyperplanes_swapped":
        return Swapped(model, objects)
    if base == "scratch":
        assert steps is not None
        return FromScratch(model, steps, settings)
    return model if steps is None else FineTuned(model, steps, settings)


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
