"""Mesh files: finding, reading, checking, cleaning, and converting materials to one form.

A file passes through `find` (or `shapenet`), `model_folder` and `files` (what may be opened), `formats` (its content),
`materials` and `clean` (what can be drawn), and `mesh`, which normalises it.
"""
