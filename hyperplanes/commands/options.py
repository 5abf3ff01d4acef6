"""Options that several verbs share, and how optional ones look in their help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

__all__ = [
    "Free",
    "ObjectArguments",
    "OptionalFile",
    "OptionalFolder",
    "OptionalInt",
    "OptionalName",
    "OptionalNumber",
    "Protocol",
    "Steps",
    "ViewsArguments",
    "ViewsUp",
    "check_fine_tune",
    "check_orbit",
    "optional",
]


def optional(metavar: str, **options: Any) -> Any:
    """What tyro is told of an option that may be left out: no {None}, no (default: None)."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", **options)


OptionalFolder = Annotated[Path | None, optional("FOLDER")]
OptionalFile = Annotated[Path | None, optional("FILE")]
OptionalInt = Annotated[int | None, optional("INT")]
OptionalName = Annotated[str | None, optional("NAME")]
OptionalNumber = Annotated[int | float | None, optional("NUMBER")]

Protocol = Literal["default", "paper", "ray_marching"]
"""A name in `hyperplanes.configuration.presets.PROTOCOLS`."""

Steps = int | Literal["auto"]
"""Fine-tuning steps, or as many as show left-out views best."""

Free = Literal["weights", "hypernetwork"]
"""What fine-tuning optimises."""

MOST_FRAMES = 10_000
"""Of an orbit."""

ViewsUp = Annotated[str, tyro.conf.arg(metavar="{auto,y,z,x,-y,-z,-x}")]
"""The axis that points up in the world of photographs, three numbers, or auto: from how the cameras are held."""


@dataclass(frozen=True, kw_only=True)
class ViewsArguments:
    """How views are read, and what is done with them before anything adapts to them.

    Attributes:
        learn_background: For photographs without masks: fit the object (the sphere at the centre of the scene) and the
            background together, and take what the object covers as masks.
        refine_poses: Refine the poses of all views first, and keep them where support views that the model is not given
            are shown better by half a decibel: for poses that are a little wrong.
        no_reflections: Do not show the model the mirror images of the views of an object that looks symmetric.
        up: The direction that points up in the world of the views: an axis such as y or -z, three numbers such as
            0,0.1,1, or auto: from how the cameras are held. Meshes, turntables and baked files have y up.
        downscale: Reduce the images by this factor, averaging pixels. When not given, images of more than a megapixel
            are reduced to at most one.
        device: auto, cpu or cuda.
    """

    learn_background: bool = False
    refine_poses: bool = False
    no_reflections: bool = False
    up: ViewsUp = "auto"
    downscale: OptionalInt = None
    device: str = "auto"


@dataclass(frozen=True)
class ObjectArguments(ViewsArguments):
    """What the verbs of one object share: a model, the views that it is shown, and how they are read.

    Attributes:
        checkpoint: What `train`, `adapt` or `demo` wrote, or a packaged model: small, small-paper, cars-64. A file that
            `bake` wrote is taken by `render` and `export`.
        views: The posed images of the object; example-car comes with the package.
        out: The folder to write to; for `bake`, the file.
        steps: Fine-tuning steps on the shown views, or auto: as many as show left-out ones best. 0 is the paper's
            single forward pass.
        all_views: Give the model all views. By default it gets every other one, the support views, and its pictures are
            compared with the rest.
    """

    checkpoint: Path
    views: Path
    out: Path
    steps: Steps = 0
    all_views: bool = False


def check_fine_tune(chosen: str, steps: int | str) -> None:
    """Refuse a choice of what fine-tuning optimises where there is none.

    Args:
        chosen: of `--fine-tune`.
        steps: of fine-tuning.

    Raises:
        ValueError: a choice, and no step.
    """
    if chosen != "weights" and steps == 0:
        raise ValueError(f"--fine-tune: expected --steps, which optimise so, got {chosen} alone; add a number of steps")


def check_orbit(orbit: int | None, size: int | None, *others: str) -> None:
    """Refuse frames and pixels of an orbit that cannot be rendered.

    Args:
        orbit: frames around the object, None for no orbit.
        size: pixels along the longer side of its pictures, None for that of the images.
        others: options beside --orbit whose pictures may have that size.

    Raises:
        ValueError: no frame or too many, no pixel, or a size of no orbit.
    """
    if orbit is not None and not 1 <= orbit <= MOST_FRAMES:
        raise ValueError(f"--orbit: expected 1 to {MOST_FRAMES} frames, got {orbit}")
    if size is not None and orbit is None:
        those = " or ".join(["--orbit", *others])
        raise ValueError(f"--size: expected {those}, whose pictures it is for, got {size} without; leave it out")
    if size is not None and size < 1:
        raise ValueError(f"--size: expected at least 1 pixel, got {size}")
