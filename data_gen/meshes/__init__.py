"""Mesh files: find, read, check, clean, and bring their materials into one form.

A file passes `find` (or `shapenet`), `model_folder` and `files` (what may be opened), `read` with `obj`, `mtl`, `gltf`
and `formats` (what it says), `materials` and `clean` (what can be drawn of it), and leaves `mesh` normalised.
"""
