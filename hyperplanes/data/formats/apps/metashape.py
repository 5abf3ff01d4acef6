"""Agisoft Metashape's XML file of cameras (File > Export > Export Cameras)."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperplanes.data.formats.apps.heads import find_by_head, only_one
from hyperplanes.data.formats.apps.photographs import find_photographs
from hyperplanes.data.formats.calibration import brown_lens, calibrated
from hyperplanes.data.pictures.frames import Frame, Listing
from hyperplanes.data.pictures.posed import check_pose
from hyperplanes.utilities.files.reading import DataError, malformed, read_bytes
from hyperplanes.utilities.messages.errors import listed

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

__all__ = ["find_cameras_files", "read_metashape"]

_LARGEST = 256 * 2**20
_SKEW = 0.5  # pixels: the largest displacement by the skew, which is then ignored
_REMEDY = "export the cameras again"


@dataclass(frozen=True)
class _Sensor:
    """Size, calibration and distortion of the images of one camera body."""

    size: tuple[int, int]
    calibrate: Callable[[tuple[int, int]], npt.NDArray[np.float64]]
    lens: tuple[float, ...]


@dataclass(frozen=True)
class _Similarity:
    """The similarity world = scale * rotation @ point + translation of a chunk or of one of its components."""

    rotation: npt.NDArray[np.float64]
    translation: npt.NDArray[np.float64]
    scale: float


def find_cameras_files(folder: Path) -> list[Path]:
    """Metashape's files of cameras in a folder."""
    return find_by_head(folder, ".xml", lambda head: "<document" in head and "<chunk" in head)


def read_metashape(folder: Path, root: Path) -> Listing:
    """The posed images of a file of cameras of Metashape, which lie beside it or in images/.

    A camera's `transform` is chunk from camera in row-major order, with OpenCV axes. The transform of its component, or
    else of the chunk, is a similarity from there into the world. Pixel coordinates start at the corner of the image:
    u = w / 2 + cx + x' (f + b1) + y' b2, v = h / 2 + cy + y' f. Here x' and y' are distorted by Brown's model with
    radial k1 to k4 and tangential p1 and p2, which are OpenCV's p2 and p1. If cameras belong to several components,
    those of the largest are taken, since each component has its own world. Masks may lie in masks/. (Metashape's
    manual, "Camera models", and nerfstudio, process_data/metashape_utils.py, which differs in two ways: it ignores the
    transforms of components, and keeps p1 and p2 in their order.)

    Returns:
        The images in the order of the file. The notes name cameras that were left out.

    Raises:
        DataError: no camera that is aligned and calibrated, a fisheye or spherical camera, skew, or malformed XML.
    """
    path = only_one(find_cameras_files(folder), folder, "XML file of cameras of Metashape")
    with malformed(path, "cameras of Metashape"):
        chunk = _chunk(path, root)
        sensors = {each.get("id", ""): _sensor(each, path) for each in chunk.iterfind("sensors/sensor")}
        moved = [each for each in chunk.iterfind("components/component") if each.find("transform") is not None]
        worlds = {each.get("id"): _similarity(each, path) for each in moved}
        cameras = list(chunk.iterfind("cameras//camera"))
        usable = [each for each in cameras if _is_aligned(each) and sensors.get(each.get("sensor_id", "")) is not None]
        if not usable:
            found = f"none of {len(cameras)}"
            raise DataError(path, "cameras that are aligned, enabled and calibrated", found, "align the photographs")
        # the component with most cameras: each component has its own world
        largest = Counter(each.get("component_id") for each in usable).most_common(1)[0][0]
        kept = [each for each in usable if each.get("component_id") == largest]
        world = worlds.get(largest) or _similarity(chunk, path)
        names = [each.get("label", "") for each in kept]
        poses = [_pose(each, world, path) for each in kept]
    pictures, masks = find_photographs(folder, names, path, root)
    frames = []
    for camera, pose, picture, mask in zip(kept, poses, pictures, masks, strict=True):
        sensor = sensors[camera.get("sensor_id", "")]
        assert sensor is not None
        written = picture.relative_to(folder).as_posix()
        frames.append(Frame(picture, written, pose, sensor.calibrate, sensor.size, sensor.lens, mask))
    left_out = [each.get("label", "") for each in cameras if each not in kept]
    why = "not aligned, not enabled, without calibration or in another component"
    notes = (f"{len(left_out)} of {len(cameras)} cameras are {why}: {listed(left_out)}",) if left_out else ()
    return Listing(frames, path, notes=notes)


def _chunk(path: Path, root: Path) -> Element:
    """The chunk with most cameras."""
    from xml.etree import ElementTree

    data = read_bytes(path, _LARGEST, root)
    if re.search(rb"<!\s*(DOCTYPE|ENTITY)", data, re.IGNORECASE):
        raise DataError(path, "plain XML", "a document type or entity", _REMEDY)
    try:
        tree = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise DataError(path, "whole XML", f"a broken file ({error})", _REMEDY) from error
    chunks = [each for each in tree.iter("chunk") if each.find("cameras") is not None]
    if not chunks:
        raise DataError(path, "a chunk with cameras", "none", _REMEDY)
    return max(chunks, key=lambda chunk: len(list(chunk.iterfind("cameras//camera"))))


def _is_aligned(camera: Element) -> bool:
    return camera.find("transform") is not None and camera.get("enabled", "true") not in ("false", "0")


def _sensor(element: Element, path: Path) -> _Sensor | None:
    """The calibration of a sensor, the adjusted one if there are several; None if there is none."""
    found = {each.get("class", ""): each for each in element.iterfind("calibration")}
    if not found:
        return None
    calibration = found.get("adjusted", next(iter(found.values())))
    where = f"{path}, sensor {element.get('id')}"
    kind = calibration.get("type") or element.get("type") or "frame"
    if kind != "frame":
        raise DataError(where, "perspective cameras (frame)", kind, "convert them, or export undistorted photographs")
    resolution = calibration.find("resolution")
    resolution = element.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise DataError(where, "a resolution", "none", _REMEDY)
    height, width = (int(resolution.get(name, "0")) for name in ("height", "width"))
    value = {each.tag: float(each.text or "nan") for each in calibration if each.tag != "resolution"}
    if "f" not in value:
        raise DataError(where, "the focal length f", ", ".join(value) or "nothing", _REMEDY)
    focal = value["f"] + value.get("b1", 0.0), value["f"]
    centre = width / 2 + value.get("cx", 0.0), height / 2 + value.get("cy", 0.0)
    calibrate = calibrated(focal, centre, (height, width), where)
    moved = abs(value.get("b2", 0.0)) * height / 2 / value["f"]
    if moved > _SKEW or value.get("p3", 0.0) or value.get("p4", 0.0):
        found_text = "p3 or p4" if moved <= _SKEW else f"a skew b2 that moves pixels by {moved:.2g}"
        raise DataError(
            where, "a lens of f, cx, cy, b1, k1 to k4, p1, p2", found_text, "optimise the cameras without it"
        )
    radial = [value.get(f"k{index}", 0.0) for index in range(1, 5)]
    reach = math.hypot(width, height) / 2 / min(focal)
    tangential = value.get("p2", 0.0), value.get("p1", 0.0)  # OpenCV's p1 and p2 are Metashape's p2 and p1
    return _Sensor((height, width), calibrate, brown_lens(radial, tangential, reach, where))


def _similarity(element: Element, path: Path) -> _Similarity:
    """The transform of a chunk or of a component; the identity if it has none."""
    transform = element.find("transform")
    if transform is None or transform.find("rotation") is None:
        return _Similarity(np.eye(3), np.zeros(3), 1.0)
    pose = np.eye(4)
    pose[:3, :3] = _numbers(transform, "rotation", 9).reshape(3, 3)
    pose[:3, 3] = _numbers(transform, "translation", 3)
    scale = float(_numbers(transform, "scale", 1)[0]) if transform.find("scale") is not None else 1.0
    if not 0 < scale < math.inf:
        raise DataError(path, "a positive scale", f"{scale:g}", _REMEDY)
    pose = check_pose(pose, path, f"transform of a {element.tag}")
    return _Similarity(pose[:3, :3], pose[:3, 3], scale)


def _pose(camera: Element, world: _Similarity, path: Path) -> npt.NDArray[np.float64]:
    """camera_from_world, OpenCV axes, as a rigid transform: only the centre is scaled."""
    chunk_from_camera = check_pose(_numbers(camera, "transform", 16).reshape(4, 4), path, camera.get("label", ""))
    rotation = world.rotation @ chunk_from_camera[:3, :3]
    centre = world.scale * world.rotation @ chunk_from_camera[:3, 3] + world.translation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ centre
    return pose


def _numbers(element: Element, name: str, count: int) -> npt.NDArray[np.float64]:
    """The numbers in the text of a child of an element; raises ValueError if they are not `count`."""
    words = (element.findtext(name) or "").split()
    if len(words) != count:
        raise ValueError(f"{name} with {len(words)} numbers instead of {count}")
    return np.array([float(word) for word in words])
