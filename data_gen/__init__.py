"""Data sets from meshes: any mesh, or procedural ones, rendered into posed images."""
