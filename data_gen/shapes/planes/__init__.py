"""Procedural planes."""
