"""Kernels of visibility: the best views of a point, and what they show of it."""
