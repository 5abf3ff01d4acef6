"""Masks of the object in photographs. Each method is a function from an image to its opacity."""
