"""Weights as safetensors beside a JSON of the configuration; no pickle is ever read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from hyperplanes import files

__all__ = [
    "CheckpointError",
    "check_tensors",
    "load_tensors",
    "read_json",
    "save_tensors",
]


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; one line that says which file, what was expected, what was found."""


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        CheckpointError: no such file, or no JSON object in it.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: expected a checkpoint's JSON file, found none; `hyperplanes train` writes one")
    try:
        return files.read_json(path)
    except files.DataError as error:
        raise CheckpointError(str(error)) from None


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write named tensors as safetensors, whole or not at all."""
    from safetensors.torch import save

    files.write_whole(path, save({name: value.detach().cpu().contiguous() for name, value in tensors.items()}))


def load_tensors(path: Path, expected: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
    """Read named tensors.

    Args:
        path: a safetensors file.
        expected: the names and shapes that must be there, no more and no less; anything where absent.

    Returns:
        Tensors by name.

    Raises:
        CheckpointError: no such file, a damaged one, or other names or shapes than expected.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        found = load_file(path)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: expected weights, found no file; `hyperplanes train` writes them") from None
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path}: expected whole safetensors, found a damaged file ({error}); copy it again"
        ) from None
    if expected is not None:
        check_tensors(path, found, expected)
    return {name: value.clone() for name, value in found.items()}  # in memory of its own, as aligned as what was saved


def check_tensors(path: Path, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Compare names and shapes, no more and no less; where the expected tensors are allocated does not matter.

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
