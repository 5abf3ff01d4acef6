"""Layouts of data sets with many objects, one module each."""

AUTHORS_FOCAL = 277.77
"""Focal length in pixels of the authors' 200x200 images: Blender's 50 mm on a sensor width of 36 mm."""
