"""Pictures from files: checked before they are decoded, always RGBA, 8 bits."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from hyperplanes.files import DataError, check_regular

__all__ = ["LARGEST_IMAGE", "composite_over_white", "image_size", "read_image"]

LARGEST_IMAGE = 64 * 10**6
"""Pixels above which an image is refused before it is decoded."""

_REMEDY = "render, export or download it again"


def image_size(path: str | Path) -> tuple[int, int]:
    """(height, width) of an image, from its header alone; DataError when there is none, or an absurd one."""
    with _open(Path(path)) as image:
        return image.height, image.width


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> tuple[npt.NDArray[np.uint8], bool]:
    """The pixels of an image.

    Args:
        path: PNG, JPEG or what else Pillow reads; more than 8 bits a channel are scaled down to 8.
        size: the (height, width) that it must have, checked before decoding.

    Returns:
        (height, width, 4) RGBA with straight alpha, and whether the file had an alpha channel (255 where it has not).

    Raises:
        DataError: no such file, not an image, truncated, of another size, or absurdly large.
    """
    path = Path(path)
    with _open(path) as image:
        found = (image.height, image.width)
        if size is not None and found != size:
            raise DataError(
                path, f"{size[1]} x {size[0]} pixels", f"{found[1]} x {found[0]}", "give all images of a scene one size"
            )
        try:
            image.load()
            alpha = "A" in image.getbands() or "transparency" in image.info
            if image.mode.startswith("I") or image.mode == "F":
                wide = np.asarray(image, dtype=np.float64)
                image = Image.fromarray((wide / max(65535.0, float(wide.max())) * 255).round().astype(np.uint8))
            return np.array(image.convert("RGBA")), alpha
        except (OSError, SyntaxError, ValueError, EOFError, IndexError) as error:
            raise DataError(path, "a whole image", f"a broken one ({error})", _REMEDY) from error


def composite_over_white(
    rgba: UInt8[Tensor, "view 4 height width"],
) -> tuple[Float[Tensor, "view 3 height width"], Float[Tensor, "view 1 height width"]]:
    """Float images in [0, 1] over white, and their masks, from straight-alpha pixels: rgb a + (1 - a).

    >>> pixel = torch.tensor([0, 255, 0, 51], dtype=torch.uint8).reshape(1, 4, 1, 1)
    >>> [round(value, 3) for value in composite_over_white(pixel)[0].flatten().tolist()]
    [0.8, 1.0, 0.8]
    """
    scaled = np.multiply(rgba.numpy(), np.float32(1 / 255))  # numpy: torch's threads cost more than they bring here
    alpha = scaled[:, 3:]
    colour = scaled[:, :3] - 1
    colour *= alpha
    colour += 1
    return torch.from_numpy(colour), torch.from_numpy(alpha.copy())


def _open(path: Path) -> Image.Image:
    """The image with only its header read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            check_regular(path)
            image = Image.open(path)
    except FileNotFoundError as error:
        raise DataError(path, "an image", "nothing", "check the name, or take the frame out") from error
    except Image.DecompressionBombError as error:
        raise DataError(path, f"at most {LARGEST_IMAGE} pixels", "far more", "scale it down") from error
    except DataError:
        raise
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(path, "an image", f"something else ({error})", _REMEDY) from error
    if image.height * image.width > LARGEST_IMAGE:
        size = f"{image.width} x {image.height}"
        image.close()
        raise DataError(path, f"at most {LARGEST_IMAGE} pixels", size, "scale it down")
    return image
