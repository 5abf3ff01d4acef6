"""Which way masks are found."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hyperplanes.capture.masks.colour import PlainBackground, is_plain
from hyperplanes.capture.masks.command import Command
from hyperplanes.capture.masks.grabcut import GrabCut
from hyperplanes.capture.masks.network import SalientObject, weights
from hyperplanes.capture.packages import is_installed, require, stated_threads
from hyperplanes.capture.sparse_model import SparseModel

__all__ = ["MASKS", "Masker", "check_mask", "choose_masker"]

MASKS = ("auto", "given", "colour", "network", "grabcut", "none")
"""Ways to find masks; a command with {image} and {mask} in it is another."""

Masker = Callable[[np.ndarray, int], np.ndarray]
"""From a picture (height, width, 3) and the number of its camera to opacity (height, width) in [0, 1]."""

LOOKED_AT = 12  # pictures by which a background is called plain


def check_mask(name: str) -> None:
    """Refuse a masking method that cannot work here, before anything else is done.

    Args:
        name: one of MASKS, or a command.

    Raises:
        ValueError: another name, a package that is missing, or a command without {image} and {mask} or whose program
            is not installed.
    """
    if name == "network":
        SalientObject()
    elif name == "grabcut":
        require("cv2", "cuts masks out of pictures")
    elif name not in MASKS:
        if " " not in name and "{" not in name:
            raise ValueError(f"--mask: expected one of {', '.join(MASKS)}, or a command, got {name!r}")
        Command(name)


def choose_masker(name: str, model: SparseModel, pictures: Sequence[np.ndarray]) -> tuple[Masker, str]:
    """A way to find masks, and its name.

    `auto` takes the colour of the background where it is plain, the network where its packages are installed,
    otherwise GrabCut.

    Args:
        name: one of MASKS but none, or a command, which `check_mask` lets pass.
        model: of structure from motion.
        pictures: one a camera.

    Raises:
        ValueError: nothing that `auto` could take is installed.
    """
    if name in ("auto", "given"):
        step = max(1, len(pictures) // LOOKED_AT)
        if is_plain(pictures[::step]):
            name = "colour"
        elif weights() is not None:
            name = "network"
        elif is_installed("cv2"):
            name = "grabcut"
        else:
            raise ValueError(
                "--mask auto: expected a plain background, or the packages that find the object in front of another "
                "one, found neither; pip install 'hyperplanes[photos]', or give masks/ or --mask none"
            )
    if name == "colour":
        plain = PlainBackground()
        return lambda picture, camera: plain(picture), "colour of the background"
    if name == "network":
        network = SalientObject(stated_threads())
        return lambda picture, camera: network(picture), "network"
    if name == "grabcut":
        return GrabCut(model), "GrabCut"
    command = Command(name)
    return lambda picture, camera: command(picture), f"command {name}"
