"""The choice of a masking method."""

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
"""The names of masking methods. A command that contains {image} and {mask} is another."""

Masker = Callable[[np.ndarray, int], np.ndarray]
"""From an image (height, width, 3) and the index of its camera to opacity (height, width) in [0, 1]."""

INSPECTED_IMAGES = 12  # about how many images are checked for a plain background


def check_mask(name: str) -> None:
    """Check that a masking method can work, before anything else is done.

    Args:
        name: one of MASKS, or a command.

    Raises:
        ValueError: another name, a missing package, or a command that lacks {image} and {mask} or whose program is not
            installed.
    """
    if name == "network":
        SalientObject()
    elif name == "grabcut":
        require("cv2", "finds masks by GrabCut")
    elif name not in MASKS:
        if " " not in name and "{" not in name:
            raise ValueError(f"--mask: expected one of {', '.join(MASKS)}, or a command, got {name!r}")
        Command(name)


def choose_masker(name: str, model: SparseModel, pictures: Sequence[np.ndarray]) -> tuple[Masker, str]:
    """A masking method, and its name for messages.

    `auto` chooses the colour of the background if it is plain, otherwise the network if its packages are installed,
    otherwise GrabCut. So does `given`, for images that came without a mask.

    Args:
        name: one of MASKS except none, or a command; `check_mask` must accept it.
        model: of structure from motion.
        pictures: the undistorted images, one per camera.

    Returns:
        The function, and the name.

    Raises:
        ValueError: the background is not plain, and no other method that `auto` could choose is installed.
    """
    if name in ("auto", "given"):
        step = max(1, len(pictures) // INSPECTED_IMAGES)
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
