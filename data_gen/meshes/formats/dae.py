"""Reads COLLADA files with pycollada and trimesh, after converting their XML to a form that both handle correctly.

trimesh omits geometry that a controller deforms or in which pycollada ignored an error; pycollada cuts all polygons
into fans.
"""

from __future__ import annotations

import io
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import trimesh

from data_gen.meshes.files import MeshError
from data_gen.meshes.model_folder import ModelFolder
from data_gen.meshes.triangulate import concave, fan, triangulate

__all__ = ["declared_up", "read_dae"]

_LUMINANCE = (0.212671, 0.715160, 0.072169)  # of red, green and blue, as COLLADA defines them

_NOT_DRAWN = ("lines", "linestrips", "points", "spline", "brep", "convex_mesh")


def read_dae(data: bytes, folder: ModelFolder) -> tuple[trimesh.Scene, list[str]]:
    """The geometries of a COLLADA file, factors of materials as in the file (sRGB), and warnings.

    Returns:
        The scene, and warnings about what is not drawn as the file states.

    Raises:
        MeshError: if it declares a document type, which COLLADA never needs, or a number is NaN.
    """
    if re.search(rb"<!\s*(DOCTYPE|ENTITY)", data, re.IGNORECASE):
        raise MeshError(f"{folder.path}: expected plain COLLADA, found a document type or entity; export it again")
    arrays = re.findall(rb"<(?:\w+:)?float_array[^>]*>([^<]*)<", data)
    unknown = sum(len(re.findall(rb"nan", array, re.IGNORECASE)) for array in arrays)
    if unknown:  # pycollada would read them as 0
        raise MeshError(f"{folder.path}: expected numbers, found {unknown} times NaN; repair or export it again")
    warnings: list[str] = []
    root = ElementTree.fromstring(data)
    namespace = root.tag.partition("}")[0] + "}" if root.tag.startswith("{") else ""
    left_out = [element.tag for element in root.iter() if element.tag.removeprefix(namespace) in _NOT_DRAWN]
    if left_out:
        warnings.append(f"{len(left_out)} sets of lines or curves left out, only triangles and polygons are drawn")
    changed = _without_controllers(root, namespace, warnings) + _without_concave_polygons(root, namespace)
    if changed:
        ElementTree.register_namespace("", namespace.strip("{}"))
        data = ElementTree.tostring(root)
    warnings += _not_drawn(data)
    from trimesh.exchange.dae import load_collada

    loaded = load_collada(io.BytesIO(data), resolver=folder)
    for geometry in loaded["geometry"].values():
        geometry["process"] = False
    return trimesh.load_scene(loaded), warnings


def declared_up(data: bytes) -> str | None:
    """The axis, `x`, `y` or `z`, that a COLLADA file declares as up; None if it declares none."""
    found = re.search(rb"<(?:\w+:)?up_axis>\s*([XYZ])_UP", data)
    return found.group(1).decode().lower() if found else None


def _not_drawn(data: bytes) -> list[str]:
    """Warnings about errors, which pycollada omits, and about translucent surfaces, which trimesh draws opaque."""
    import collada
    from collada.common import DaeError

    document = collada.Collada(io.BytesIO(data), ignore=[DaeError])
    lines = [f"left out: {' '.join(str(error).split())[:150] or type(error).__name__}" for error in document.errors]
    for effect in document.effects:
        opacity = _opacity(effect)
        if opacity < 1:
            lines.append(f"effect {effect.id!r}: drawn opaque, its opacity of {opacity:.2g} left out")
    return lines


def _opacity(effect: Any) -> float:
    """Opacity of a plain colour ("Determining Transparency" in the specification of COLLADA 1.4.1)."""
    share = effect.transparency if isinstance(effect.transparency, (int, float)) else 1.0
    through = effect.transparent if isinstance(effect.transparent, (tuple, list)) else None
    if str(effect.opaque_mode) == "RGB_ZERO":
        return 1.0 if through is None else 1.0 - float(np.dot(through[:3], _LUMINANCE)) * share
    return share * (1.0 if through is None or len(through) < 4 else float(through[3]))


def _without_controllers(root: ElementTree.Element, namespace: str, warnings: list[str]) -> int:
    """Replace controllers by the geometry that they deform, and return how many."""
    sources: dict[str, str] = {}
    for controller in root.iter(f"{namespace}controller"):
        for kind in ("skin", "morph"):
            deformed = controller.find(f"{namespace}{kind}")
            if deformed is not None:
                sources["#" + controller.get("id", "")] = deformed.get("source", "")
    count = 0
    for instance in root.iter(f"{namespace}instance_controller"):
        url = instance.get("url", "")
        for _ in range(len(sources)):  # such as a skin of a morph of a geometry
            url = sources.get(url, url)
        instance.tag = f"{namespace}instance_geometry"
        instance.set("url", url)
        for skeleton in instance.findall(f"{namespace}skeleton"):
            instance.remove(skeleton)
        count += 1
    if count:
        for library in root.findall(f"{namespace}library_controllers"):
            root.remove(library)
        warnings.append(f"{count} controllers: drawn in the pose of their meshes, not of their skeletons")
    return count


def _without_concave_polygons(root: ElementTree.Element, namespace: str) -> int:
    """Rewrite sets of polygons that contain concave ones as triangles, and return how many sets."""
    count = 0
    for mesh in root.iter(f"{namespace}mesh"):
        for polygons in [*mesh.findall(f"{namespace}polylist"), *mesh.findall(f"{namespace}polygons")]:
            inputs = polygons.findall(f"{namespace}input")
            width = 1 + max((int(each.get("offset", 0)) for each in inputs), default=0)
            sizes, index = _indices(polygons, namespace, width)
            points = _positions(mesh, namespace, inputs)
            offset = next((int(each.get("offset", 0)) for each in inputs if each.get("semantic") == "VERTEX"), 0)
            if points is None or sizes.min(initial=3) < 3 or sizes.sum() != len(index):
                continue  # pycollada reports it, too
            if len(index) and not 0 <= index[:, offset].min() <= index[:, offset].max() < len(points):
                continue
            triangles = _triangles(sizes, points[index[:, offset]])
            if triangles is None:
                continue
            for child in [each for each in polygons if each not in inputs]:
                polygons.remove(child)
            polygons.tag = f"{namespace}triangles"
            polygons.set("count", str(len(triangles)))
            ElementTree.SubElement(polygons, f"{namespace}p").text = " ".join(map(str, index[triangles].ravel()))
            count += 1
    return count


def _indices(
    polygons: ElementTree.Element, namespace: str, width: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Corners of each polygon (polygon,), and the indices of all corners (corner, width)."""
    texts = [each.text or "" for each in polygons.findall(f"{namespace}p")]
    lists = [np.array(text.split(), dtype=np.int64) for text in texts]
    counted = polygons.find(f"{namespace}vcount")
    if counted is None:
        sizes = np.array([len(each) // width for each in lists], dtype=np.int64)
    else:
        sizes = np.array((counted.text or "").split(), dtype=np.int64)
    joined = np.concatenate(lists) if lists else np.zeros(0, dtype=np.int64)
    return sizes, joined[: len(joined) // width * width].reshape(-1, width)


def _positions(mesh: ElementTree.Element, namespace: str, inputs: list[Any]) -> npt.NDArray[np.float64] | None:
    """The vertices (vertex, 3) of a mesh; None if they are not three plain numbers each."""
    position = mesh.find(f"{namespace}vertices/{namespace}input[@semantic='POSITION']")
    if position is None or not any(each.get("semantic") == "VERTEX" for each in inputs):
        return None
    for source in mesh.findall(f"{namespace}source"):
        if "#" + source.get("id", "") == position.get("source"):
            array = source.find(f"{namespace}float_array")
            accessor = source.find(f"{namespace}technique_common/{namespace}accessor")
            if array is None or accessor is None or (accessor.get("stride"), accessor.get("offset", "0")) != ("3", "0"):
                return None
            values = np.array((array.text or "").split(), dtype=np.float64)
            return values[: len(values) // 3 * 3].reshape(-1, 3)
    return None


def _triangles(sizes: npt.NDArray[np.int64], corners: npt.NDArray[np.float64]) -> npt.NDArray[np.int64] | None:
    """Corner indices (triangle, 3) of polygons with consecutive corners; None if none is concave."""
    starts = np.cumsum(sizes) - sizes
    is_concave = np.zeros(len(sizes), dtype=bool)
    for size in np.unique(sizes[sizes > 3]):
        alike = np.flatnonzero(sizes == size)
        is_concave[alike] = concave(corners[starts[alike, None] + np.arange(size)])
    if not is_concave.any():
        return None
    cut = [
        start + (triangulate(corners[start : start + size]) if turned else fan(size))
        for start, size, turned in zip(starts, sizes, is_concave, strict=True)
    ]
    return np.concatenate(cut)
