"""What a native data set holds besides images: depth, normals, surface coordinates, and the mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hyperplanes.data.formats.arrays import read_arrays
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.messages.arguments import checked

__all__ = ["CHANNEL_DIMENSIONS", "mesh_path", "read_channel"]

CHANNEL_DIMENSIONS = {"depth": 3, "normals": 4, "coordinates": 4}
"""The channels, and the number of dimensions of each."""

_REMEDY = "generate the data set with this channel"


@checked
def read_channel(folder: str | Path, channel: str) -> Tensor:
    """One channel of all views of an object, in the order of its frames (not split into support and query).

    The channels are float32 and 0 where the ray hits nothing. "depth" is the distance along the camera's z axis in
    world units, (view, height, width). "normals" are unit vectors in world axes that face the camera, and "coordinates"
    are surface points in world units, both (view, height, width, 3).

    Args:
        folder: of the object.
        channel: a key of CHANNEL_DIMENSIONS.

    Returns:
        The values, exactly as they were rendered.

    Raises:
        ValueError: an unknown channel.
        DataError: the object was generated without this channel, or the file is malformed.
    """
    if channel not in CHANNEL_DIMENSIONS:
        raise ValueError(f"channel: expected one of {', '.join(CHANNEL_DIMENSIONS)}, got {channel!r}")
    path = Path(folder) / f"{channel}.npz"
    if not path.is_file():
        raise DataError(path, f"the {channel} of the object", "nothing", _REMEDY)
    values = read_arrays(path, {channel}).get(channel)
    if values is None or values.ndim != CHANNEL_DIMENSIONS[channel] or values.dtype != np.float32:
        found = "another array" if values is None else f"{values.dtype} {values.shape}"
        raise DataError(path, f"a float32 array {channel} of {CHANNEL_DIMENSIONS[channel]} dimensions", found, _REMEDY)
    return torch.from_numpy(values)


def mesh_path(folder: str | Path) -> Path:
    """The GLB file of an object's mesh, in the world of its cameras.

    Args:
        folder: of the object.

    Returns:
        The path of a file that exists.

    Raises:
        DataError: the object was generated without its mesh.
    """
    path = Path(folder) / "mesh.glb"
    if not path.is_file():
        raise DataError(path, "the mesh of the object", "nothing", _REMEDY)
    return path
