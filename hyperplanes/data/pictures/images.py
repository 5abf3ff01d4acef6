"""Read images from files as RGBA with 8 bits, after a check of their headers."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageFilter
from PIL.TiffImagePlugin import TiffImageFile
from torch import Tensor

from hyperplanes.geometry.occupancy import MIN_MASK_OPACITY
from hyperplanes.utilities.files.reading import DataError, check_regular

__all__ = [
    "FORMATS",
    "HEIF_SUFFIXES",
    "LARGEST_IMAGE",
    "PICTURE_SUFFIXES",
    "VIDEO_SUFFIXES",
    "Header",
    "Pixels",
    "composite_over_white",
    "image_header",
    "image_size",
    "opacity_of",
    "read_image",
    "read_mask",
    "reduced",
    "resized",
    "turned",
    "without_haze",
]

LARGEST_IMAGE = 64 * 10**6
"""Pixels above which an image is refused before it is decoded."""

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF", "PPM", "JPEG2000", "HEIF")
"""Formats that Pillow may decode, whatever the file name; for some other formats it would start external programs. HEIF
works once pillow-heif has registered it."""

PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"})
"""Lower-case suffixes of files that are taken for images."""

HEIF_SUFFIXES = frozenset({".heic", ".heif"})
"""Lower-case suffixes of photographs that Pillow reads once pillow-heif has registered their format."""

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"})
"""Lower-case suffixes of files that are taken for videos."""

Pixels = npt.NDArray[np.uint8]

MIN_HAZY_SHARE = 0.01  # of a picture: pixels that are faint and next to faint ones only, of a hazy background
_OVERSHOOT = 1.5  # largest ratio of a floating-point value to white; masks resampled by Lanczos reach 1.49
_REMEDY = "render, export or download it again"
_ORIENTATION = 0x0112  # tag of EXIF: 1 is upright, 2 to 8 are the other rotations and reflections
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


@dataclass(frozen=True)
class Header:
    """What the header of an image states.

    Attributes:
        size: (height, width) of the pixels as they are stored.
        orientation: EXIF's orientation, 1 if the pixels are stored upright or the header states none.
    """

    size: tuple[int, int]
    orientation: int

    @property
    def upright_size(self) -> tuple[int, int]:
        """(height, width) after the rotation that EXIF's orientation requires."""
        height, width = self.size
        return (width, height) if self.orientation >= 5 else self.size


def image_header(path: str | Path) -> Header:
    """The header of an image; raises DataError if it cannot be read, or states more than LARGEST_IMAGE pixels."""
    with _open(Path(path)) as image:
        orientation = 1
        if "exif" in image.info:  # without this check, getexif would decode a whole PNG
            try:
                orientation = int(image.getexif().get(_ORIENTATION, 1))
            except (TypeError, ValueError, SyntaxError, OSError):
                orientation = 1  # a damaged tag is ignored
        return Header((image.height, image.width), orientation if orientation in _TURNS else 1)


def image_size(path: str | Path) -> tuple[int, int]:
    """(height, width) of the stored pixels of an image; raises DataError as `image_header` does."""
    return image_header(path).size


def turned(picture: Pixels, orientation: int) -> Pixels:
    """An image (height, width, 4) rotated and mirrored as EXIF's orientation requires."""
    return picture if orientation == 1 else np.array(Image.fromarray(picture).transpose(_TURNS[orientation]))


def resized(picture: Pixels, size: tuple[int, int]) -> Pixels:
    """An image (height, width, 4) with straight alpha, scaled to another (height, width) with its borders in place."""
    if picture.shape[:2] == size:
        return picture
    scaled = Image.fromarray(picture).convert("RGBa").resize((size[1], size[0]), Image.Resampling.BILINEAR)
    return np.array(scaled.convert("RGBA"))


def check_downscale(factor: int, size: tuple[int, int], source: str | Path) -> None:
    """Raise DataError if images of this (height, width) cannot be scaled down by this factor."""
    if not 1 <= factor <= min(size):
        found = f"{factor} for images of {size[1]} x {size[0]} pixels"
        raise DataError(source, f"a downscale from 1 to {min(size)}", found, "give another --downscale")


def reduced(picture: Pixels, factor: int) -> Pixels:
    """An image (height, width, 4) with straight alpha, reduced by averaging blocks of factor x factor pixels.

    Rows and columns at the end that fill no whole block are left out.
    """
    if factor == 1:
        return picture
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    image = Image.fromarray(picture).convert("RGBa").reduce(factor, (0, 0, width * factor, height * factor))
    return np.array(image.convert("RGBA"))


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> tuple[npt.NDArray[np.uint8], bool]:
    """The pixels of an image.

    Args:
        path: a file in one of FORMATS. More than 8 bits per channel are scaled down to 8, except that 0 and 1 stay 0
            and 1 if all integers of an image are. In a floating-point image, white is the first of 1, 255 and 65535
            that no value exceeds by more than half, since resampled masks exceed white.
        size: the (height, width) that it must have, checked before decoding.

    Returns:
        (height, width, 4) RGBA with straight alpha, and whether the file has an alpha channel (otherwise alpha is 255).

    Raises:
        DataError: no such file, not an image, truncated, of another size, or more than LARGEST_IMAGE pixels.
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
                wide = np.nan_to_num(np.asarray(image, dtype=np.float64)).clip(0)
                white = _white(image.mode, float(wide.max()))
                image = Image.fromarray((wide / white * 255).round().clip(0, 255).astype(np.uint8))
            return np.array(image.convert("RGBA")), alpha
        except (OSError, SyntaxError, ValueError, EOFError, IndexError) as error:
            raise DataError(path, "a whole image", f"a broken one ({error})", _REMEDY) from error


def opacity_of(mask: Pixels, has_alpha: bool) -> UInt8[np.ndarray, "height width"]:
    """The opacity that an image of a mask states: its alpha if some pixel is not opaque, otherwise its largest channel.

    So the mask may also be a photograph whose background is transparent. If the largest value is 1, 1 marks the object
    and becomes 255. Otherwise haze becomes 0 (`without_haze`).

    Args:
        mask: (height, width, 4), as `read_image` returns it.
        has_alpha: as `read_image` returns it.
    """
    by_alpha = has_alpha and bool((mask[..., 3] < 255).any())
    opacity = mask[..., 3] if by_alpha else mask[..., :3].max(-1)
    return opacity * np.uint8(255) if opacity.max() == 1 else without_haze(opacity)


def read_mask(path: str | Path, size: tuple[int, int] | None = None) -> UInt8[np.ndarray, "height width"]:
    """The opacity that the file of a mask states, as `opacity_of` says.

    A palette with colours means labels, as in the masks of PASCAL VOC, YouTube-VOS and DAVIS: label 0 is the background
    and all others are opaque. A palette of greys gives the opacity.

    Args:
        path: as in `read_image`.
        size: as in `read_image`.

    Returns:
        8 bits, 255 where the object is. Raises DataError as `read_image` does.
    """
    values, has_alpha = read_image(path, size)
    if not has_alpha and (values[..., :1] != values[..., 1:3]).any():
        with _open(Path(path)) as image:
            if image.mode == "P":
                return np.where(np.asarray(image) > 0, np.uint8(255), np.uint8(0))
    return opacity_of(values, has_alpha)


def without_haze(opacity: Pixels) -> Pixels:
    """8-bit opacity of a picture; if its background is hazy, values below MIN_MASK_OPACITY become 0.

    A hull treats every value above 0 as a part of the object, and many programs that cut objects out leave 1 or 2 of
    255 all over the background. Where only edges have such values, they belong to the object and do not change. They
    are replaced where files are read, before images are scaled down: the mean of an edge and its background may be
    smaller than MIN_MASK_OPACITY.

    >>> without_haze(np.array([[1, 1, 1, 3, 200]], np.uint8)).tolist(), without_haze(np.array([[0, 3, 200]], np.uint8))
    ([[0, 0, 0, 0, 200]], array([[  0,   3, 200]], dtype=uint8))
    """
    least = 255 * MIN_MASK_OPACITY
    faint = (opacity > 0) & (opacity < least)
    if not faint.any():
        return opacity
    around = np.asarray(Image.fromarray(opacity).filter(ImageFilter.MaxFilter(3)))
    is_hazy = (faint & (around < least)).mean() > MIN_HAZY_SHARE
    return np.where(faint, np.uint8(0), opacity) if is_hazy else opacity


def composite_over_white(
    rgba: UInt8[Tensor, "view 4 height width"],
) -> tuple[Float[Tensor, "view 3 height width"], Float[Tensor, "view 1 height width"]]:
    """Float images in [0, 1] over white, and their masks, from straight-alpha pixels: rgb a + (1 - a).

    >>> pixel = torch.tensor([0, 255, 0, 51], dtype=torch.uint8).reshape(1, 4, 1, 1)
    >>> [round(value, 3) for value in composite_over_white(pixel)[0].flatten().tolist()]
    [0.8, 1.0, 0.8]
    """
    pixels = rgba.numpy()  # NumPy, since PyTorch's threads cost more time here than they save
    colour, alpha = (np.multiply(part, np.float32(1 / 255), order="C") for part in (pixels[:, :3], pixels[:, 3:]))
    colour -= 1
    colour *= alpha
    colour += 1
    return torch.from_numpy(colour), torch.from_numpy(alpha)


def _white(mode: str, largest: float) -> float:
    """The value of white in an image of one of Pillow's modes with more than 8 bits, by its largest value."""
    if mode != "F":
        return 255.0 if largest == 1 else max(65535.0, largest)  # zeros and ones of a mask stay as they are
    return next((white for white in (1.0, 255.0, 65535.0) if largest <= _OVERSHOOT * white), largest)


def _open(path: Path) -> Image.Image:
    """The image with only its header read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            check_regular(path)
            known = Image.OPEN.keys() | set(FORMATS[:-1])  # HEIF is in Image.OPEN only once it is registered
            image = Image.open(path, formats=[each for each in FORMATS if each in known])
    except FileNotFoundError as error:
        raise DataError(path, "an image", "nothing", "check the name, or take the frame out") from error
    except Image.DecompressionBombError as error:
        raise DataError(path, f"at most {LARGEST_IMAGE} pixels", "more", "scale it down") from error
    except DataError:
        raise
    except PermissionError as error:
        raise DataError(path, "an image that may be read", "no permission", "check its permissions") from error
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(path, "an image", f"something else ({error})", _REMEDY) from error
    orientation = image.tag_v2.get(_ORIENTATION, 1) if isinstance(image, TiffImageFile) else 1
    if orientation != 1:  # Pillow rotates such files itself, and scrambles the pixels of uncompressed ones
        image.close()
        raise DataError(path, "a TIFF that is stored upright", f"orientation {orientation}", "save it again, as PNG")
    if image.height * image.width > LARGEST_IMAGE:
        size = f"{image.width} x {image.height}"
        image.close()
        raise DataError(path, f"at most {LARGEST_IMAGE} pixels", size, "scale it down")
    return image
