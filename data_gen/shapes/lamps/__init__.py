"""Procedural lamps."""
