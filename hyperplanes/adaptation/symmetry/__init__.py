"""Symmetry of an object: its detection from views, and reflected views as further views."""
