"""Slow, obvious loops that the fast code is compared with. Nothing here is shared with the package."""

import math

import numpy as np
import torch

NEAREST = 1e-4
BORDER = 0.01  # pixels


def project(matrix, point):
    """(column, row, depth) of a world point under a 3 x 4 matrix; None behind the camera."""
    h = [sum(float(matrix[row][k]) * float(point[k]) for k in range(3)) + float(matrix[row][3]) for row in range(3)]
    return None if not NEAREST < h[2] < math.inf else (h[0] / h[2], h[1] / h[2], h[2])


def bilinear(image, column, row):
    """Colour (channel,) between the four pixel centres around (column, row), which lies inside the image."""
    _, height, width = image.shape
    x, y = min(int(math.floor(column)), max(width - 2, 0)), min(int(math.floor(row)), max(height - 2, 0))
    right, below = min(x + 1, width - 1), min(y + 1, height - 1)
    fx, fy = column - x, row - y
    top = image[:, y, x] * (1 - fx) + image[:, y, right] * fx
    low = image[:, below, x] * (1 - fx) + image[:, below, right] * fx
    return top * (1 - fy) + low * fy


def unpack(packed):
    """Images (view, 3, height, width) in [0, 1] of words that hold three channels of 8, or of 11, 11 and 10 bits."""
    channels = []
    for first, width in ((0, 8), (8, 8), (16, 8)) if packed.bits == 8 else ((0, 11), (11, 11), (22, 10)):
        largest = 2**width - 1
        channels.append(((packed.words >> first) & largest).float() / largest)
    return torch.stack(channels, 1)


def lookup(points, matrices, images, views=None, background=1.0):
    """Colours (point, view, channel), coordinates (point, view, 2), valid (point, view), one lookup at a time."""
    chosen = [list(range(len(images)))] * len(points) if views is None else [list(row) for row in views]
    slots = len(images) if views is None else np.asarray(views).shape[1]
    channels, height, width = images.shape[1:]
    colours = np.full((len(points), slots, channels), background)
    coordinates = np.zeros((len(points), slots, 2))
    valid = np.zeros((len(points), slots), bool)
    for p, point in enumerate(points):
        for slot, view in enumerate(chosen[p]):
            seen = project(matrices[view], point)
            if seen is None:
                continue
            for axis, size in enumerate((width, height)):
                inside = min(max(seen[axis], 0.0), size - 1.0)
                coordinates[p, slot, axis] = 2 * inside / max(size - 1, 1) - 1
            last = (width - 1, height - 1)
            if all(-BORDER <= seen[axis] <= last[axis] + BORDER for axis in (0, 1)):
                valid[p, slot] = True
                colours[p, slot] = bilinear(images[view], *(min(max(seen[a], 0.0), float(last[a])) for a in (0, 1)))
    return colours, coordinates, valid


def hull(masks, matrices, centres, half_diagonal):
    """Which voxels no view rules out: none whose bounding ball's picture misses every set pixel of some mask."""
    kept = np.ones(len(centres), bool)
    for index, centre in enumerate(centres):
        for mask, matrix in zip(masks, matrices, strict=True):
            seen = project(matrix, centre)
            if seen is None:
                continue
            column, row = round(seen[0]), round(seen[1])
            height, width = mask.shape
            focal = max(np.linalg.norm(matrix[0][:3]), np.linalg.norm(matrix[1][:3]))
            reach = math.ceil(2 * focal * half_diagonal / seen[2]) + 1
            if min(column, row) < reach or column + reach >= width or row + reach >= height:
                continue  # part of the ball may lie beyond the picture
            if not mask[row - reach : row + reach + 1, column - reach : column + reach + 1].any():
                kept[index] = False
    return kept
