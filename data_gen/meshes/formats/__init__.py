"""Readers of mesh files, a module per format: `read` picks one and checks what it returns; `gltf` writes, too."""
