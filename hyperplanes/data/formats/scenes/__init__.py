"""Layouts of single scenes, one module each."""
