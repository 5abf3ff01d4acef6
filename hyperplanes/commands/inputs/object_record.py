"""Records which views the weights of one object were made from, so that later commands notice other views."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hyperplanes.views import Views

__all__ = ["other_object", "record_object"]

RECORD = "object.json"  # in the folder of the weights


def record_object(weights: Path, name: str, support: Views) -> None:
    """Write the record of an object beside its weights.

    Args:
        weights: the folder of a checkpoint.
        name: of the object.
        support: the views that the weights were made from.
    """
    from hyperplanes.utilities.files.writing import write_json

    write_json(weights / RECORD, {"name": name, "views": _digests(support)})


def other_object(weights: Path, support: Views) -> str | None:
    """A warning if weights were made from other views; None if there is no record or at least one view is the same.

    Args:
        weights: a checkpoint.
        support: the views that the field will read.

    Raises:
        DataError: a damaged record.
    """
    from hyperplanes.utilities.files.reading import DataError, malformed, read_json

    path = weights / RECORD
    if not path.is_file():
        return None
    with malformed(path, "a record that `adapt` wrote"):
        record = read_json(path)
        name, recorded = record["name"], record["views"]
        if not isinstance(recorded, list):
            raise DataError(path, "a list of views", f"a {type(recorded).__name__}", "run `hyperplanes adapt` again")
    if set(recorded) & set(_digests(support)):
        return None
    return (
        f"{weights}: these weights were made from other images, of {name}, and fit no other object; give the images "
        "and options that `adapt` was given, or a model that adapts to these images, such as small"
    )


def _digests(views: Views) -> list[str]:
    """A hash of each image, with 8 bits a channel."""
    pixels = (views.images * 255).round().byte().cpu().numpy()
    return [hashlib.sha256(image.tobytes()).hexdigest()[:16] for image in pixels]
