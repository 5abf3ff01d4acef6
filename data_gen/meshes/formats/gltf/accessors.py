"""Accessors: arrays in the buffers of a glTF file, plain, strided or sparse, of floats or of quantised integers."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from data_gen.meshes.files import MeshError
from data_gen.meshes.formats.gltf.container import Document, not_negative

__all__ = ["as_numbers", "check_accessors", "read_accessor", "read_numbers"]

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_SPARSE_BYTES = 1 << 27


def check_accessors(document: Document) -> None:
    """Check that each accessor lies inside its buffer view, so that no more is allocated than the file can fill.

    Raises:
        MeshError: if one does not, or has neither data nor an extension with compressed data.
    """
    compressed = _compressed_accessors(document)
    for index, accessor in enumerate(document.items("accessors")):
        where = f"{document.path}: accessor {index}"
        count, dtype, columns = accessor["count"], _dtype(accessor), _COLUMNS[accessor["type"]]
        if "bufferView" in accessor:
            _check_block(document, accessor, count, dtype.itemsize * columns, where)
        elif "sparse" not in accessor and index not in compressed:
            raise MeshError(f"{where}: expected data, found an empty accessor; export it again")
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            if "bufferView" not in accessor and count * dtype.itemsize * columns > _MAX_SPARSE_BYTES:
                raise MeshError(f"{where}: expected at most {_MAX_SPARSE_BYTES} bytes of zeros, found {count} items")
            indices = sparse["indices"]
            _check_block(document, indices, sparse["count"], _dtype(indices).itemsize, f"{where}: sparse indices")
            _check_block(
                document, sparse["values"], sparse["count"], dtype.itemsize * columns, f"{where}: sparse values"
            )


def _check_block(document: Document, block: dict[str, Any], count: Any, item: int, where: str) -> None:
    view = document.items("bufferViews")[not_negative(block["bufferView"])]
    stride, offset = view.get("byteStride", item), block.get("byteOffset", 0)
    if not isinstance(count, int) or count < 0 or stride < item or offset < 0:
        raise MeshError(f"{where}: expected items of {item} bytes, found {count} of {stride} bytes; export it again")
    need = offset + (max(count, 1) - 1) * stride + item
    if need > view["byteLength"]:
        raise MeshError(
            f"{where}: expected {count} items in {view['byteLength']} bytes, found that they need {need}; "
            "export it again"
        )


def _compressed_accessors(document: Document) -> set[int]:
    """Indices of the accessors whose data is in a compressed block."""
    found: set[int] = set()
    for mesh in document.items("meshes"):
        for primitive in mesh["primitives"]:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                found |= {*primitive["attributes"].values(), primitive.get("indices", -1)}
    return found


def _dtype(accessor: dict[str, Any]) -> np.dtype[Any]:
    return np.dtype(_DTYPES[accessor["componentType"]])


def read_accessor(document: Document, index: int) -> npt.NDArray[Any]:
    """The items of a checked accessor, as stored in the file.

    Returns:
        Its items `(item, column)`; `(item,)` for scalars.

    Raises:
        MeshError: if it has no data, or sparse indices out of range.
    """
    accessor = document.items("accessors")[not_negative(index)]
    count, dtype, columns = accessor["count"], _dtype(accessor), _COLUMNS[accessor["type"]]
    if "bufferView" in accessor:
        found = _block(document, accessor, count, dtype, columns)
    elif "sparse" in accessor:
        found = np.zeros((count, columns), dtype=dtype)
    else:
        raise MeshError(f"{document.path}: accessor {index}: expected data, found an empty accessor; export it again")
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        places = _block(document, sparse["indices"], sparse["count"], _dtype(sparse["indices"]), 1)[:, 0]
        if len(places) and places.max() >= count:
            raise MeshError(
                f"{document.path}: accessor {index}: expected sparse indices below {count}, found {places.max()}; "
                "export it again"
            )
        found[places] = _block(document, sparse["values"], sparse["count"], dtype, columns)
    return found[:, 0] if columns == 1 else found


def read_numbers(document: Document, index: int) -> npt.NDArray[np.float64]:
    """The items of an accessor as numbers: normalised integers in [0, 1] or [-1, 1], others unchanged."""
    found = read_accessor(document, index)
    return as_numbers(found, normalised=bool(document.items("accessors")[index].get("normalized")))


def as_numbers(values: npt.NDArray[Any], *, normalised: bool) -> npt.NDArray[np.float64]:
    """Items as numbers.

    >>> as_numbers(np.array([0, 51, 255], dtype=np.uint8), normalised=True).tolist()
    [0.0, 0.2, 1.0]
    >>> as_numbers(np.array([-128, 127], dtype=np.int8), normalised=True).tolist()
    [-1.0, 1.0]
    """
    numbers = values.astype(np.float64)
    if normalised and values.dtype.kind in "iu":
        numbers = np.maximum(numbers / np.iinfo(values.dtype).max, -1.0)
    return numbers


def _block(
    document: Document, block: dict[str, Any], count: int, dtype: np.dtype[Any], columns: int
) -> npt.NDArray[Any]:
    """Items (item, column) at the offset and stride of a buffer view."""
    view = document.items("bufferViews")[block["bufferView"]]
    item = dtype.itemsize * columns
    stride = view.get("byteStride", item)
    if count == 0:
        return np.zeros((0, columns), dtype=dtype)
    data = np.frombuffer(document.view(block["bufferView"]), dtype=np.uint8, offset=block.get("byteOffset", 0))
    rows = np.lib.stride_tricks.as_strided(data, (count, item), (stride, 1), writeable=False)
    return rows.copy().view(dtype)  # trimesh drops colours in read-only arrays
