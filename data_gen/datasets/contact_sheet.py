"""Contact sheets: many small pictures in one, to check a data set at a glance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

__all__ = ["contact_sheet"]

_GAP, _LABEL = 4, 14


def contact_sheet(images: Sequence[np.ndarray], columns: int, labels: Sequence[str] | None = None) -> np.ndarray:
    """Lay images out in rows over white.

    Args:
        images: arrays (H, W, 3) or (H, W, 4), uint8 sRGB, all of one height and width; alpha is straight and composited
            over white.
        columns: images per row.
        labels: a caption under each image, truncated to its width; none if absent.

    Returns:
        The sheet (rows * cell height, columns * cell width, 3), uint8, 4 pixels between the images.

    Raises:
        ValueError: if there are no images, their sizes or types differ from the above, columns is not positive, or the
            number of labels is not that of the images.
    """
    if not images or columns < 1:
        raise ValueError(
            f"contact_sheet: expected images and columns >= 1, got {len(images)} images, {columns} columns"
        )
    height, width = images[0].shape[:2]
    for k, image in enumerate(images):
        if (
            image.dtype != np.uint8
            or image.ndim != 3
            or image.shape[:2] != (height, width)
            or image.shape[2] not in (3, 4)
        ):
            raise ValueError(
                f"images[{k}]: expected uint8 ({height}, {width}, 3 or 4) as the first, got {image.dtype} {image.shape}"
            )
    if labels is not None and len(labels) != len(images):
        raise ValueError(f"labels: expected {len(images)}, one an image, got {len(labels)}")
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    cell_width, cell_height = width + _GAP, height + _GAP + (_LABEL if labels is not None else 0)
    sheet = Image.new("RGB", (columns * cell_width + _GAP, rows * cell_height + _GAP), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for k, image in enumerate(images):
        x, y = _GAP + (k % columns) * cell_width, _GAP + (k // columns) * cell_height
        picture = Image.fromarray(image)
        sheet.paste(picture, (x, y), picture if image.shape[2] == 4 else None)
        if labels is not None:
            text = labels[k]
            while text and draw.textlength(text) > width:
                text = text[:-1]
            draw.text((x + 1, y + height + 1), text, fill=(60, 60, 60))
    return np.array(sheet)
