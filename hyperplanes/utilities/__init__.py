"""Helpers shared by all packages: files, settings, entry points, error messages, formatting, metrics, a cache."""
