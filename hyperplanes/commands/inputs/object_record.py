"""Records which views the weights of one object were made from, so that later commands notice other views."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hyperplanes.commands.output.console import Console
    from hyperplanes.views import Views

__all__ = ["record_object", "warn_of_other_object"]

RECORD = "object.json"  # in the folder of the weights


def record_object(weights: Path, name: str, support: Views | None) -> None:
    """Write the record of an object beside its weights, or delete one that is there.

    Args:
        weights: the folder of a checkpoint.
        name: of the object.
        support: the views that the weights were made from; None if later commands cannot reproduce their pixels.
    """
    from hyperplanes.utilities.files.writing import write_json

    path = weights / RECORD
    if support is None:
        path.unlink(missing_ok=True)
    else:
        write_json(path, {"name": name, "views": _digests(support)})


def warn_of_other_object(weights: Path, support: Views, console: Console) -> None:
    """Warn if weights were made from other views: there is a record, and it has none of these.

    Args:
        weights: a checkpoint. DataError if its record is damaged.
        support: the views that the field will read.
        console: prints the warning.
    """
    from hyperplanes.utilities.files.reading import malformed, read_json

    path = weights / RECORD
    if not path.is_file():
        return
    with malformed(path, "a record that `hyperplanes adapt` wrote"):
        record = read_json(path)
        name, recorded = record["name"], set(record["views"])
    if not recorded & set(_digests(support)):
        console.warn(
            f"{weights}: these weights were made from other images, of {name}, and fit no other object; give the "
            "images and options that `adapt` was given, or a model that adapts to these images, such as small"
        )


def _digests(views: Views) -> list[str]:
    """A hash of each image, with 8 bits a channel."""
    pixels = (views.images * 255).round().byte().cpu().numpy()
    return [hashlib.sha256(image.tobytes()).hexdigest()[:16] for image in pixels]
