"""Surfaces of fields: meshes, textures and point clouds."""
