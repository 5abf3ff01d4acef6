"""What colours a mesh: trimesh says that it may be nothing, or one of two classes; here it is one of the two."""

from __future__ import annotations

import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals

__all__ = ["Visual", "texture_of", "visual_of"]

Visual = ColorVisuals | TextureVisuals


def visual_of(mesh: trimesh.Trimesh) -> Visual:
    """The colours or the texture of a mesh; colours that are not defined where it has neither.

    >>> visual_of(trimesh.Trimesh()).defined
    False
    """
    visual = mesh.visual
    return ColorVisuals(mesh) if visual is None else visual


def texture_of(mesh: trimesh.Trimesh) -> TextureVisuals | None:
    """The texture of a mesh, if it has one."""
    visual = mesh.visual
    return visual if isinstance(visual, TextureVisuals) else None
