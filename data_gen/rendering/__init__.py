"""Rendering of meshes: `mesh_renderer` draws with pyrender on OpenGL, or with Embree.

`renderers` finds out which of them works, `surfaces` converts meshes for both, `lighting` and `shading` are the same
for both.
"""
