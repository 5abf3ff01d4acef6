"""Tensors: precision, transforms, caches, seeds and optimisers."""
