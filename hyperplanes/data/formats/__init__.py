"""Readers of the supported layouts, one module each, and `recognise`, which finds the layout of a path."""
