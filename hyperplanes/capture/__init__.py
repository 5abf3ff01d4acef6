"""Make a scene from photographs or a video of an object: find camera poses, masks and the position of the object."""

from hyperplanes.capture.pipeline import Captured, Settings, capture

__all__ = ["Captured", "Settings", "capture"]
