"""Read the points of a sparse reconstruction beside the cameras: COLMAP's, or a PLY file with positions alone."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.scenes.colmap import find_model, image_names
from hyperplanes.data.formats.scenes.transforms_json import find_transforms
from hyperplanes.utilities.files.reading import check_regular, inside, malformed, read_bytes, read_json, read_text

__all__ = ["SparsePoints", "read_sparse_points"]


@dataclass(frozen=True)
class SparsePoints:
    """Points that structure from motion found.

    Attributes:
        places: positions (point, 3) in the world of the cameras.
        error: reprojection error in pixels, the mean over all observations of points; None if it is unknown.
        errors: mean reprojection error of the points that an image shows, by the name of the image; empty if unknown.
    """

    places: npt.NDArray[np.float64]
    error: float | None = None
    errors: Mapping[str, float] = field(default_factory=dict)


def read_sparse_points(folder: str | Path) -> SparsePoints | None:
    """The points beside the cameras of a scene.

    Args:
        folder: of the scene: a COLMAP project or model with points3D.bin or .txt, or one with a transforms.json that
            names a PLY file as `ply_file_path`, as nerfstudio and `capture` write.

    Returns:
        The points, None if there are none. Raises DataError for a malformed file.
    """
    folder = Path(folder)
    transforms = find_transforms(folder)
    if transforms:
        name = read_json(transforms[0], folder).get("ply_file_path")
        path = inside(folder, name, transforms[0]) if isinstance(name, str) else None
        return _of_ply(path, folder) if path is not None and path.is_file() else None
    model = find_model(folder)
    for name in ("points3D.bin", "points3D.txt"):
        if model is not None and (model / name).is_file():
            return _of_colmap(model, model / name, folder)
    return None


def _of_ply(path: Path, root: Path) -> SparsePoints:
    import trimesh

    check_regular(path, root=root)
    with malformed(path, "a PLY file of points"), open(path, "rb") as file:
        loaded = trimesh.load(file, "ply", process=False)
        places = np.asarray(getattr(loaded, "vertices", np.zeros((0, 3))), np.float64).reshape(-1, 3)
    return SparsePoints(places)


def _of_colmap(model: Path, path: Path, root: Path) -> SparsePoints:
    with malformed(path, "the points of a COLMAP model"):
        names = image_names(model, root)
        points = _binary(read_bytes(path, root=root)) if path.suffix == ".bin" else _text(read_text(path, root=root))
        sums: dict[str, list[float]] = {}
        for _, error, images in points:
            for image in images:
                sums.setdefault(names[image], []).append(error)
        places = np.array([place for place, _, _ in points], np.float64).reshape(-1, 3)
        every = [error for values in sums.values() for error in values]
        errors = {name: float(np.mean(values)) for name, values in sums.items()}
    return SparsePoints(places, float(np.mean(every)) if every else None, errors)


Point = tuple[tuple[float, ...], float, set[int]]
"""The position of a point, its mean reprojection error, and the numbers of the images that show it."""


def _binary(data: bytes) -> list[Point]:
    points: list[Point] = []
    at = 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        x, y, z, error, length = struct.unpack_from("<3d3xdQ", data, at + 8)
        track = struct.unpack_from(f"<{2 * length}i", data, at + 51)
        points.append(((x, y, z), error, set(track[::2])))
        at += 51 + 8 * length
    return points


def _text(text: str) -> list[Point]:
    points: list[Point] = []
    for words in (line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")):
        place = tuple(float(word) for word in words[1:4])
        points.append((place, float(words[7]), {int(word) for word in words[8::2]}))
    return points
