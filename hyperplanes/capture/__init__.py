"""Photographs or a video of an object to a scene: camera poses, masks, and where the object is."""

from hyperplanes.capture.pipeline import Captured, Settings, capture

__all__ = ["Captured", "Settings", "capture"]
