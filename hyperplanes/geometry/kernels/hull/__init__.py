"""Kernels of the visual hull: carving, hits of rays, and the pixels that see it."""
