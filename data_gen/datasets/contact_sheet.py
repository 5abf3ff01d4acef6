"""Contact sheets: many small pictures in one, to check a data set at a glance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

__all__ = ["contact_sheet"]

_GAP, _LABEL = 4, 14


def contact_sheet(images: Sequence[np.ndarray], columns: int, labels: Sequence[str]) -> np.ndarray:
    """Lay images out in rows over white.

    Args:
        images: arrays (H, W, 4), uint8 sRGB, all of one height and width; alpha is straight and composited over white.
        columns: images per row.
        labels: a caption under each image, truncated to its width.

    Returns:
        The sheet (rows * cell height, columns * cell width, 3), uint8, 4 pixels between the images.
    """
    height, width = images[0].shape[:2]
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    cell_width, cell_height = width + _GAP, height + _GAP + _LABEL
    sheet = Image.new("RGB", (columns * cell_width + _GAP, rows * cell_height + _GAP), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for k, (image, text) in enumerate(zip(images, labels, strict=True)):
        x, y = _GAP + (k % columns) * cell_width, _GAP + (k // columns) * cell_height
        picture = Image.fromarray(image)
        sheet.paste(picture, (x, y), picture)
        while text and draw.textlength(text) > width:
            text = text[:-1]
        draw.text((x + 1, y + height + 1), text, fill=(60, 60, 60))
    return np.array(sheet)
