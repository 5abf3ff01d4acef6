"""Options that several verbs share, and how options with the default None are shown in the help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from hyperplanes.configuration.fine_tuning import Steps
from hyperplanes.data.packaged import locate_scene, remedy_for
from hyperplanes.utilities.files.reading import DataError

__all__ = [
    "DATA_SET",
    "POSED_IMAGES",
    "Exists",
    "Free",
    "ObjectArguments",
    "OptionalFile",
    "OptionalFolder",
    "OptionalInt",
    "OptionalName",
    "OptionalNumber",
    "Protocol",
    "ViewsArguments",
    "ViewsUp",
    "check_fine_tune",
    "check_orbit",
    "optional",
]


def optional(metavar: str, **options: Any) -> Any:
    """The annotation for tyro of an option with the default None: the help shows no {None} and no (default: None)."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", **options)


@dataclass(frozen=True)
class Exists:
    """Marks an option, `Annotated[Path, Exists(...)]`, with one or more paths at which something must exist.

    The command line checks it before it runs a verb, so that a wrong path is refused before torch is imported.

    Attributes:
        expected: What is expected at the path, for the error.
        remedy: What to do if it is not there.
        folder: Whether it must be a folder.
        packaged: Whether the name of a scene that comes with the package is a path too.
    """

    expected: str
    remedy: str = "check the path"
    folder: bool = False
    packaged: bool = False

    def check(self, path: Path) -> None:
        """Refuse a path.

        Args:
            path: the value of the option, or one of its values.

        Raises:
            DataError: nothing exists at the path, or a file where a folder is expected.
        """
        place = locate_scene(path) if self.packaged else path
        if place.is_dir() or (place.exists() and not self.folder):
            return
        missing = "a link to nothing" if place.is_symlink() else "nothing"
        remedy = remedy_for(path, self.remedy) if self.packaged else self.remedy
        raise DataError(path, self.expected, "a file" if place.exists() else missing, remedy)


DATA_SET = Exists("the folder of a data set", "check the path, or run hyperplanes generate", packaged=True)
"""Marks a data set, or one posed scene."""

POSED_IMAGES = Exists("a transforms*.json or the folder of a scene", packaged=True)
"""Marks the posed images of one scene."""

OptionalFolder = Annotated[Path | None, optional("FOLDER")]
OptionalFile = Annotated[Path | None, optional("FILE")]
OptionalInt = Annotated[int | None, optional("INT")]
OptionalName = Annotated[str | None, optional("NAME")]
OptionalNumber = Annotated[int | float | None, optional("NUMBER")]

Protocol = Literal["default", "paper", "ray_marching"]
"""A name in `hyperplanes.configuration.presets.PROTOCOLS`."""

Free = Literal["weights", "hypernetwork"]
"""What fine-tuning optimises."""

MOST_FRAMES = 10_000
"""Most frames of an orbit."""

ViewsUp = Annotated[str, tyro.conf.arg(metavar="{auto,y,z,x,-y,-z,-x}")]
"""The direction that points up in the world of the views: an axis, three numbers, or auto, as in `read_scene`."""


@dataclass(frozen=True, kw_only=True)
class ViewsArguments:
    """Options for reading views and preparing them before a model adapts to them.

    Attributes:
        learn_background: For photographs without masks: fit the object, in the sphere at the centre of the scene, and
            the background together, and use the pixels that the object covers as masks.
        refine_poses: For poses that are slightly wrong: refine the poses of all views first. The refined poses are used
            if they raise the PSNR of held-out support views by 0.5 dB or more.
        no_reflections: Do not give the model mirror images of the views of an object that looks symmetric.
        up: The direction that points up in the world of the views: an axis such as y or -z, three numbers such as
            0,0.1,1, or auto. auto takes what the files state, or else guesses it from how the cameras are held.
            Meshes, turntables and baked files have y up.
        downscale: Reduce the images by this factor, averaging pixels. By default, images of more than a megapixel are
            reduced to at most one.
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
    """Options of the verbs for one object: a model, the views that it is given, and how they are read.

    Attributes:
        checkpoint: A folder that `train`, `adapt` or `demo` wrote, or a packaged model: small, small-paper, cars-64.
            `render` and `export` also take a file that `bake` wrote.
        views: The posed images of the object. example-car comes with the package.
        out: The folder to write to; for `bake`, the file.
        steps: Fine-tuning steps on the support views, or auto for the number that is best for held-out views. 0 is the
            paper's single forward pass.
        all_views: Give the model all views. By default it is given every other view, the support views, and its
            pictures are compared with the rest.
    """

    checkpoint: Path
    views: Annotated[Path, POSED_IMAGES]
    out: Path
    steps: Steps = 0
    all_views: bool = False


def check_fine_tune(chosen: str, steps: int | str) -> None:
    """Refuse a choice of what fine-tuning optimises if there is no fine-tuning.

    Args:
        chosen: the value of `--fine-tune`.
        steps: the number of fine-tuning steps.

    Raises:
        ValueError: a value other than the default, and no steps.
    """
    if chosen != "weights" and steps == 0:
        raise ValueError(f"--fine-tune: expected --steps as well, got {chosen} alone; add a number of steps")


def check_orbit(orbit: int | None, size: int | None, *others: str) -> None:
    """Refuse a number of frames or a size that an orbit cannot have.

    Args:
        orbit: number of frames around the object; None for no orbit.
        size: pixels along the longer side of the frames; None for the size of the images.
        others: further options, besides --orbit, to which the size applies.

    Raises:
        ValueError: no frames or too many, no pixels, or a size without an orbit.
    """
    if orbit is not None and not 1 <= orbit <= MOST_FRAMES:
        raise ValueError(f"--orbit: expected 1 to {MOST_FRAMES} frames, got {orbit}")
    if size is not None and orbit is None:
        those = " or ".join(["--orbit", *others])
        raise ValueError(f"--size: expected {those} as well, got {size} alone; leave it out")
    if size is not None and size < 1:
        raise ValueError(f"--size: expected at least 1 pixel, got {size}")
