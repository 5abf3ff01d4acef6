"""glTF 2 and GLB files: container and checks, accessors, materials, primitives, scenes; reading and writing."""

from data_gen.meshes.formats.gltf.read import read_gltf
from data_gen.meshes.formats.gltf.write import write_glb

__all__ = ["read_gltf", "write_glb"]
