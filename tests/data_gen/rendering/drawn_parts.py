"""Meshes for tests of the renderer, also in other processes. The module imports little, so that these start fast."""

import sys

import numpy as np
import trimesh
from PIL import Image

from data_gen import rigs
from data_gen.rendering.mesh_renderer import MeshRenderer


def sheet(size=1.0, *, uv=True):
    """A square in the plane z = 0 that faces +z."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    if uv:
        mesh.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
    mesh.metadata["smooth"] = False
    return mesh


def placed(mesh, pose):
    """A transformed copy of a mesh."""
    return mesh.copy().apply_transform(pose)


def tricky_parts():
    """Parts with a texture, vertex colours, face colours, reversed faces, mirrored faces, an alpha cutoff and glass."""
    generator = np.random.default_rng(0)
    texels = generator.integers(0, 255, (16, 16, 3), dtype=np.uint8).repeat(16, axis=0).repeat(16, axis=1)
    textured = trimesh.creation.box((0.6, 0.6, 0.6))
    uv = generator.uniform(0.0, 1.0, (len(textured.vertices), 2))
    textured.metadata["smooth"] = False
    textured.visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(texels))
    ball = trimesh.creation.icosphere(3, radius=0.3)
    ball.visual.vertex_colors = np.clip(ball.vertices * 400 + 128, 0, 255).astype(np.uint8)
    ball.invert()
    block = trimesh.creation.box((0.4, 0.3, 0.2))
    block.visual.face_colors = generator.integers(30, 255, (len(block.faces), 4), dtype=np.uint8) | [0, 0, 0, 255]
    glass = sheet(0.8)
    glass.visual.material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[20, 60, 200, 100], alphaMode="BLEND", metallicFactor=1.0, roughnessFactor=0.2
    )
    fence = sheet(0.5)
    bars = np.zeros((8, 8, 4), np.uint8)
    bars[:, ::2] = (200, 120, 40, 255)
    fence.visual.material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(bars).resize((128, 128), Image.Resampling.NEAREST), alphaMode="MASK"
    )
    place = trimesh.transformations.translation_matrix
    mirrored = place([0.2, 0.5, 0.2]) @ np.diag([-1.0, 1.5, 1.0, 1.0])
    return [
        placed(textured, place([-0.4, -0.3, 0.0])),
        placed(ball, place([0.4, 0.0, -0.2])),
        placed(block, mirrored),
        placed(glass, place([0.0, 0.0, 0.55])),
        placed(fence, place([-0.2, 0.3, -0.6]) @ trimesh.transformations.rotation_matrix(0.4, [0, 1, 0])),
    ]


def draw_tricky(backend):
    """The tricky parts drawn by one renderer, as RGBA (view, height, width, 4)."""
    return MeshRenderer(backend).render(tricky_parts(), rigs.fixed(4, 48)).rgba


if __name__ == "__main__":
    np.savez(sys.argv[1], **{name: draw_tricky(name) for name in sys.argv[2:]})
