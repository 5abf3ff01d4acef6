"""Settings as earlier versions wrote them, by the names of this one: of checkpoints and of files of settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hyperplanes.utilities.settings import SettingsError

__all__ = ["TARGETS", "upgrade_model", "upgrade_training"]

MODEL = {"hull_side": "hull_resolution", "judged": "stacked"}
NETWORK = {"point_octaves": "point_frequencies", "direction_octaves": "direction_frequencies"}
TRAINING = {"final": "final_rate_factor", "completion": "volume_loss"}
"""Entries by their former names."""

TARGETS = {"any_order": "image_based"}
"""Fields by their former names."""

OF_IMAGE_BASED = ("blended", "grid")
OF_IMAGES = ("encoder", "views", "choice", "resolution", "normalisation", "join", "see_directions")
OF_HEADS = (
    *("code", "code_normalisation", "depth", "width", "activation", "layers", "update", "rank"),
    *("see_weights", "weights_seen", "centre"),
)
"""What every network, and every hypernetwork, was once written with, whether it read it or not."""

REMOVED: dict[str, object] = {"gain": 1.0, "code_activation": "none"}
"""Settings of hypernetworks that are gone, with the value that left them off; docs/hypernetwork.md says why."""

REMOVED_FROM_MODEL = ("second_pass",)
"""Of what a model was once configured to do or not, what every one does now."""

REMOVED_FROM_TRAINING: dict[str, object] = {"alternating": False, "average": 0.0}
"""Settings of a training that are gone, with the value that left them off."""


def upgrade_model(entries: Any) -> Any:
    """The entries of a model, or some of them, as this version names them; those of this version as they are.

    >>> upgrade_model({"hull_side": 64, "hypernetwork": {"encoder": "volume", "gain": 1.0, "views": 5}})
    {'hull_resolution': 64, 'hypernetwork': {'kind': 'volume'}}

    Args:
        entries: what a file or options say; anything but a mapping is returned as it is.

    Returns:
        New entries. A setting that is gone, at another value than the one that left it off, is a SettingsError.
    """
    if not isinstance(entries, Mapping):
        return entries
    result = {MODEL.get(name, name): value for name, value in entries.items() if name not in REMOVED_FROM_MODEL}
    if result.get("protocol") == "marched":
        result["protocol"] = "ray_marching"
    if isinstance(target := result.get("target"), str):
        result["target"] = TARGETS.get(target, target)
    if isinstance(network := result.get("network"), Mapping):
        result["network"] = _network(network, result.get("target"))
    if isinstance(hypernetwork := result.get("hypernetwork"), Mapping):
        result["hypernetwork"] = _hypernetwork(hypernetwork)
    return result


def _network(entries: Mapping[str, Any], target: object) -> dict[str, Any]:
    """The shape of a network; former names tell that all kinds were written with the settings of all."""
    former = any(name in entries for name in NETWORK)
    dropped = OF_IMAGE_BASED if former and target in ("nerf", "multiplane", "point_multiplane") else ()
    return {NETWORK.get(name, name): value for name, value in entries.items() if name not in dropped}


def _hypernetwork(entries: Mapping[str, Any]) -> dict[str, Any]:
    """The shape of a hypernetwork; its encoder once told which kind it is."""
    for name, off in REMOVED.items():
        if entries.get(name, off) != off:
            problem = f"expected {off!r}, since this setting was removed, got {entries[name]!r}"
            raise SettingsError(f"hypernetwork.{name}", problem)
    result = {name: value for name, value in entries.items() if name not in REMOVED}
    if result.get("kind") == "volume":
        return {name: value for name, value in result.items() if name not in OF_HEADS}
    dropped = (*OF_IMAGES, *OF_HEADS)
    if "encoder" not in result or "kind" in result:
        return result
    if result["encoder"] == "volume":
        return {"kind": "volume", **{name: value for name, value in result.items() if name not in dropped}}
    return {"kind": "images", **result}


def upgrade_training(entries: Any) -> Any:
    """The entries of a training's settings as an earlier version wrote them, by the names of this one.

    >>> upgrade_training({"final": 0.1, "average": 0.0})
    {'final_rate_factor': 0.1}

    Args:
        entries: what a file or an option says; anything but a mapping is returned as it is.

    Raises:
        SettingsError: a setting that is gone, at another value than the one that left it off.
    """
    if not isinstance(entries, Mapping):
        return entries
    for name, off in REMOVED_FROM_TRAINING.items():
        if entries.get(name, off) != off:
            raise SettingsError(name, f"expected {off}, since this setting was removed, got {entries[name]}")
    return {TRAINING.get(name, name): value for name, value in entries.items() if name not in REMOVED_FROM_TRAINING}
