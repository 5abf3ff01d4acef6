"""RealityCapture's and RealityScan's table of cameras: "Internal/External camera parameters"."""

from __future__ import annotations

import csv
import math
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.apps.heads import find_by_head, only_one
from hyperplanes.data.formats.apps.photographs import find_photographs
from hyperplanes.data.formats.calibration import brown_lens, calibration_matrix
from hyperplanes.data.formats.scenes.transforms_document import opencv_from_opengl
from hyperplanes.data.pictures.frames import Frame, Listing
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.utilities.files.reading import DataError, malformed, read_text

__all__ = ["find_tables", "read_realitycapture", "world_from_angles"]

_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_FILM = 36.0  # millimetres: the sensor size that f assumes along the longer side of the image
_LARGEST = 64 * 2**20
_REMEDY = "export Internal/External camera parameters again"


def find_tables(folder: Path) -> list[Path]:
    """The tables of cameras in a folder."""
    return find_by_head(folder, ".csv", lambda head: _header(head.splitlines()) is not None)


def _header(lines: list[str]) -> int | None:
    """The index of the line that names the columns, which "#cameras N" may precede; None if there is none."""
    for number, line in enumerate(lines[:2]):
        if set(_NEEDED) <= set(_columns(line)):
            return number
    return None


def _columns(line: str) -> list[str]:
    """The names of the columns in lower case."""
    return [name.strip().lower() for name in line.lstrip("#").split(",")]


def read_realitycapture(folder: Path, root: Path) -> Listing:
    """The posed images of a table of cameras of RealityCapture, which lie beside it or in images/.

    The position is x, y, alt; for the angles see `world_from_angles`. f is the focal length in millimetres on a sensor
    of 36 mm along the longer side of the image. px and py are the offset of the principal point from the middle, in
    units of the longer side (y down), like PrincipalPointU and V of XMP files. k1 to k4 are Brown's radial
    coefficients, t1 and t2 OpenCV's tangential ones. Columns may have any order. Those of the distortion and the
    principal point may be missing. Masks may lie in masks/. (Columns and angles: nerfstudio,
    process_data/realitycapture_utils.py, which guesses another unit of px and py. That unit and the distortion:
    "RealityCapture XMP Camera Math", support.capturingreality.com.)

    Returns:
        The images in the order of the table. Raises DataError if a file is missing or malformed.
    """
    path = only_one(find_tables(folder), folder, "table of cameras of RealityCapture")
    names, cameras = _rows(path, root)
    pictures, masks = find_photographs(folder, names, path, root)
    frames = []
    for name, camera, picture, mask in zip(names, cameras, pictures, masks, strict=True):
        where = f"{path}, {name}"
        with malformed(where, "cameras of RealityCapture"):
            pose = np.eye(4)
            pose[:3, :3] = world_from_angles(camera["heading"], camera["pitch"], camera["roll"])
            pose[:3, 3] = camera["x"], camera["y"], camera["alt"]
            focal = camera["f"] / _FILM
            centre = camera.get("px", 0.0), camera.get("py", 0.0)
            calibration_matrix((focal, focal), centre, where)  # raises an error before any image is read
            radial, tangential = (
                [camera.get(f"{kind}{i}", 0.0) for i in range(1, n)] for kind, n in (("k", 5), ("t", 3))
            )
            lens = brown_lens(radial, tangential, math.sqrt(0.5) / focal, where)
        opencv = opencv_from_opengl(check_pose(pose, path, name)[None])[0]
        written = picture.relative_to(folder).as_posix()
        frames.append(Frame(picture, written, opencv, partial(_calibration, focal, centre), None, lens, mask))
    return Listing(frames, path)


def world_from_angles(heading: float, pitch: float, roll: float) -> npt.NDArray[np.float64]:
    """The (3, 3) rotation of a camera with OpenGL axes, from RealityCapture's angles in degrees.

    If all three are zero, the camera looks straight down in a world with z up, and the top of its image points towards
    y. The heading is clockwise, seen from above.

    >>> (world_from_angles(90, 0, 0).round() + 0.0).tolist()
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()


def _calibration(focal: float, centre: tuple[float, float], size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """The calibration of an image of (height, width), from focal length and offset in units of its longer side."""
    longer = max(size)
    middle = size[1] / 2 + centre[0] * longer, size[0] / 2 + centre[1] * longer
    return calibration_matrix((focal * longer, focal * longer), middle, "")


def _rows(path: Path, root: Path) -> tuple[list[str], list[dict[str, float]]]:
    """The names and the numbers of all cameras."""
    with malformed(path, "a table of cameras"):
        lines = read_text(path, _LARGEST, root).removeprefix("\ufeff").splitlines()
        start = _header(lines)
        if start is None:
            raise DataError(path, f"the columns {', '.join(_NEEDED)}", lines[0][:60] if lines else "nothing", _REMEDY)
        columns, names, cameras = _columns(lines[start]), [], []
        for number, row in enumerate(csv.reader(lines[start + 1 :]), start + 2):
            if not row:
                continue
            if len(row) != len(columns):
                raise DataError(f"{path}, line {number}", f"{len(columns)} columns", f"{len(row)}", _REMEDY)
            named = dict(zip(columns, row, strict=True))
            names.append(named["name"].strip())
            cameras.append(_numbers(named, f"{path}, line {number}"))
    if not names:
        raise DataError(path, "a line for each camera", "none", _REMEDY)
    return names, cameras


def _numbers(row: dict[str, str], where: str) -> dict[str, float]:
    """The numbers of a line. Columns of text, which an export template may add, are left out unless they are needed."""
    numbers = {}
    for name, text in row.items():
        try:
            numbers[name] = float(text)
        except ValueError:
            if name in _NEEDED[1:]:
                raise DataError(where, f"a number as {name}", repr(text)[:40], _REMEDY) from None
    return numbers
