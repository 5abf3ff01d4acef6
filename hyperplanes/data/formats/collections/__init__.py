"""Layouts of data sets with many objects, one module each."""
