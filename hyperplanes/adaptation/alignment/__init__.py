"""The frame and the symmetry in which a model reads the views of an object."""
