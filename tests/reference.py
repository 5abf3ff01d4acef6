"""Slow reference implementations as plain loops. They share no code with the package."""

import math

import numpy as np
import torch

NEAREST = 1e-4
BORDER = 0.01  # pixels


def project(matrix, point):
    """Project a world point by a 3 x 4 matrix to (column, row, depth); None if it is behind the camera."""
    h = [sum(float(matrix[row][k]) * float(point[k]) for k in range(3)) + float(matrix[row][3]) for row in range(3)]
    return None if not NEAREST < h[2] < math.inf else (h[0] / h[2], h[1] / h[2], h[2])


def bilinear(image, column, row):
    """The colour (channel,) at (column, row) inside the image, interpolated between pixel centres."""
    _, height, width = image.shape
    x, y = min(int(math.floor(column)), max(width - 2, 0)), min(int(math.floor(row)), max(height - 2, 0))
    right, below = min(x + 1, width - 1), min(y + 1, height - 1)
    fx, fy = column - x, row - y
    top = image[:, y, x] * (1 - fx) + image[:, y, right] * fx
    low = image[:, below, x] * (1 - fx) + image[:, below, right] * fx
    return top * (1 - fy) + low * fy


def unpack(packed):
    """Unpack words of 8, 8 and 8 or of 11, 11 and 10 bits to images (view, 3, height, width) in [0, 1]."""
    channels = []
    for first, width in ((0, 8), (8, 8), (16, 8)) if packed.bits == 8 else ((0, 11), (11, 11), (22, 10)):
        largest = 2**width - 1
        channels.append(((packed.words >> first) & largest).float() / largest)
    return torch.stack(channels, 1)


def lookup(points, matrices, images, views=None, background=1.0):
    """Look up points in views, one at a time: colours (point, view, channel), coordinates (point, view, 2), valid."""
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
    """The visual hull: booleans that are true for voxels that no mask rules out.

    A mask rules a voxel out if the projection of the voxel's bounding ball lies inside the image, and no pixel of the
    mask in its bounding box is set.
    """
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
                continue  # part of the ball may lie outside the image
            if not mask[row - reach : row + reach + 1, column - reach : column + reach + 1].any():
                kept[index] = False
    return kept
