"""Weights as safetensors beside a JSON of the configuration; no pickle is ever read.

Every file carries a checksum of its tensors, and none holds a number that is not finite.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hyperplanes.utilities.files import reading as files
from hyperplanes.utilities.files import writing

__all__ = [
    "CheckpointError",
    "check_tensors",
    "load_tensors",
    "read_json",
    "save_tensors",
]

CHECKSUM = "sha256"  # entry of the file's own metadata
MAX_CHECKPOINT_BYTES = 64 * 2**30  # bytes


class CheckpointError(files.DataError):
    """A checkpoint that cannot be used; one line that says which file, what was expected, what was found."""


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; DataError where the file holds something else.

    Raises:
        CheckpointError: no such file.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: expected a checkpoint's JSON file, found none; `hyperplanes train` writes one")
    return files.read_json(path)


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write named tensors as safetensors, whole or not at all, with their checksum.

    Raises:
        CheckpointError: a number that is not finite; the file that was there stays.
    """
    from safetensors.torch import save

    content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    if (name := _not_finite(content)) is not None:
        raise CheckpointError(
            f"{path}: expected finite numbers to save, found NaN or infinity in {name}; nothing was written and what "
            "was saved before stays; train with lower rates"
        )
    writing.write_whole(path, save(content, {CHECKSUM: _checksum(content)}))


def load_tensors(path: Path, expected: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
    """Read named tensors.

    Args:
        path: a safetensors file.
        expected: tensors of exactly the names and shapes required; anything where absent.

    Returns:
        Tensors by name. DataError where there is no regular file.

    Raises:
        CheckpointError: no such file, a damaged one or one of another kind, other names or shapes than expected,
            tensors that do not match their checksum (files of other programs have none), or a number that is not
            finite.
    """
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise CheckpointError(
            f"{path}: expected weights, found no file; check the path; `hyperplanes train` writes those of models"
        )
    files.check_regular(path, MAX_CHECKPOINT_BYTES)
    try:
        with safe_open(path, "pt") as file:
            checksum = (file.metadata() or {}).get(CHECKSUM)
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError, ValueError, TypeError, RuntimeError) as error:
        damaged = f"expected whole safetensors, found a damaged file ({error}); copy it again"
        other = "expected safetensors, found a file of another kind, which is no checkpoint; check the path"
        raise CheckpointError(f"{path}: {other if _is_of_another_kind(path) else damaged}") from None
    if expected is not None:
        check_tensors(path, found, expected)
    if checksum is not None and checksum != _checksum(found):
        raise CheckpointError(
            f"{path}: expected the tensors of its checksum {checksum[:12]}, found others; the file has changed since "
            "it was written: copy it again"
        )
    if (name := _not_finite(found)) is not None:
        raise CheckpointError(f"{path}: expected finite numbers, found NaN or infinity in {name}; train or bake again")
    return {name: value.clone() for name, value in found.items()}  # own, aligned memory


def _is_of_another_kind(path: Path) -> bool:
    """Whether a file does not begin as safetensors do: with the length of a JSON object in 8 bytes, and the object."""
    with suppress(OSError), open(path, "rb") as file:
        return file.read(9)[8:] not in (b"", b"{")
    return False


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes, independent of order."""
    result = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        result.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        result.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return result.hexdigest()


def _not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The name of the first tensor with a number that is not finite."""
    floating = (name for name, value in tensors.items() if value.is_floating_point() or value.is_complex())
    return next((name for name in floating if not torch.isfinite(tensors[name]).all()), None)


def check_tensors(path: Path, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Check that names and shapes are exactly the expected ones, on any device.

    Args:
        path: where they were found, for the message.
        found: tensors by name.
        expected: what they should look like.

    Raises:
        CheckpointError: a missing or a surplus name, or another shape.
    """
    for name, value in expected.items():
        if name not in found:
            raise CheckpointError(
                f"{path}: expected a tensor {name!r}, found none; the configuration is of another model"
            )
        if found[name].shape != value.shape:
            raise CheckpointError(
                f"{path}: expected {name} of shape {tuple(value.shape)}, found {tuple(found[name].shape)}; "
                "the configuration is of another model"
            )
    if surplus := sorted(set(found) - set(expected)):
        raise CheckpointError(
            f"{path}: expected {len(expected)} tensors, found {len(surplus)} more, as {surplus[0]!r}; "
            "the configuration is of another model"
        )
