"""Meshes and cameras to pictures: `mesh_renderer` draws with pyrender on OpenGL, or with Embree.

`renderers` finds out which of them works, `surfaces` brings meshes into the form that both draw, `lighting` and
`shading` are the same for both.
"""
