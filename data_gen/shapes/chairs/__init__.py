"""Procedural chairs."""
