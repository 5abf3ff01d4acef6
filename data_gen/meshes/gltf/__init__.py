"""glTF 2 and GLB files: container and checks, accessors, materials, primitives, and the scene they make."""

from data_gen.meshes.gltf.read import read_gltf

__all__ = ["read_gltf"]
